"""The numbers of the surfel estimation in one record: neighbors, layers, sides, ends of discs, borders of colors."""

from dataclasses import dataclass

NEIGHBORS = 20  # of a point, which counts as its own first neighbor
Pair = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Constants:
    """Constants of the surfel estimation.  A pair is a range: bounds, or start and end of a ramp.

    Lengths are in spacings of the points, or in units of the box (half diagonal 1) where marked.  Weights count
    neighbors: one at the point's own position weighs 1.  Cosines and shares have no unit.  A thickness is a standard
    deviation of heights.
    """

    # spacing
    raw_neighbors: int = 6  # in the disc whose area gives the raw spacing
    least_spacing: float = 1e-5  # in units of the box, for points that coincide
    single_spacing: float = 0.1  # in units of the box, for a single point
    disc_weight: float = 3.0  # summed weight of the neighbors in the disc whose area gives the spacing
    disc_share: float = 0.6  # upper bound of that weight: share of the layer's total weight
    spacing_bounds: Pair = (0.5, 1.2)  # of the ratio of the spacing to the raw spacing; the upper keeps thin legs thin
    averaged_neighbors: int = 9  # neighbors over which spacing and visibility are averaged
    distance_sigma: float = 1.2  # standard deviation of the weight of a neighbor's distance

    # layers: a plane through the point and two neighbors, then a quadric
    plane_neighbors: int = 8  # nearest neighbors whose pairs span the candidate planes
    least_plane_sine: float = 0.2  # least sine of the angle between two neighbors that span a plane
    plane_height: float = 0.1  # height above a plane at which a neighbor's support is one half
    least_squares_bonus: float = 1.15  # factor on the support of the least-squares plane: better for noisy points
    fit_rounds: int = 4  # of the quadric's fit
    slope_ridge: float = 1e-3  # added to the normal equations for slopes
    bend_ridge: float = 0.1  # added for curvatures
    mixed_ridge: float = 0.05  # added for the mixed curvature: half, so that the result does not depend on the axes
    step_ridge: float = 0.01  # added for a step between two colors
    first_thickness: float = 0.12  # in the first round
    thickness_bounds: Pair = (0.04, 0.3)  # in later rounds
    thickness_per_deviation: float = 2.0  # thickness over the mean absolute height of the layer's neighbors
    loose_thickness: float = 2.0  # factor on the thickness of the layer that colors and spacings are taken from
    other_layer: float = 3.0  # thicknesses beyond which a neighbor belongs to another layer
    parallel_cosine: float = 0.8  # least cosine between the normals of parallel layers

    # splits: two surfaces closer than the thickness of a layer; a point lies on the one of its color
    color_sigma: float = 0.1  # standard deviation for the similarity of two colors, in square roots of linear colors
    split_thickness: float = 0.02  # least thickness where colors separate two surfaces
    split_share: float = 0.3  # least share of certain points among the neighbors of similar color
    # thresholds for possible and for certain splits: step over the thickness; tolerance of the step (1 / its variance
    # inflation factor: about 1 - R^2 of its regression on slopes and curvatures); neighbors of each color; step over
    # its standard error
    step_height: Pair = (1.5, 3.0)
    step_independence: Pair = (0.3, 0.7)
    step_points: Pair = (1.0, 2.0)
    step_significant: Pair = (3.0, 6.0)

    # orientation of normals
    thin_wall_height: float = 1.5  # height below which another layer is the other side of a thin wall
    thin_wall_weight: float = 3.0  # weight of that vote
    flip_vote: float = 0.5  # a given normal is flipped if the vote against it exceeds this
    vote_ridge: float = 1.0  # added to the denominator of a vote: a few directions alone decide nothing
    orientation_ramp: Pair = (0.15, 0.45)  # votes at which `one_sided` begins to rise and reaches 1
    visibility_spacing_bounds: Pair = (0.5, 2.0)  # of a point's spacing over the median one, for the depth buffers
    back_weight: float = 0.02  # weight of the back of a one-sided disc: better than a hole

    # ends of discs
    rim_radius: float = 2.2  # neighbors within this distance determine where a layer ends
    edge_cosine: float = 0.75  # cosine between normals below which two faces meet at an edge
    edge_sine: float = 0.3  # sine between normals above which a plane cuts a disc
    cut_margin: float = 0.1  # by which a disc extends beyond the line where another face cuts it
    cut_cosine: float = 0.8  # least cosine between the direction to such a line and one of a disc's four directions
    rim_margin: float = 0.25  # by which a surface extends beyond the last point of its layer, whatever gaps are covered
    largest_radius: float = 4.0  # radius of a disc without an end

    # gaps between random points
    even: float = 0.66  # evenness from which points are even: gaps are holes
    widest_gap: float = 2.2  # radius of the largest gap that is bridged
    duplicate_distance: float = 5e-7  # half the squared distance below which two points coincide
    gap_cover: float = 0.95  # distance to the middle of a gap, in spacings as enlarged, at most

    # colors
    color_edge_sigma: float = 1.6  # standard deviation of a neighbor's weight by its distance
    color_edge_least_weight: float = 0.01  # least weight at which a neighbor bounds the line
    contrast: Pair = (0.06, 0.16)  # between the two colors, in square roots of linear ones
    parted_variance: Pair = (0.8, 0.9)  # share of the variance of the colors that lies between the two groups
    other_color_share: Pair = (0.03, 0.06)  # share of the neighbors that lie beyond the line
    wrong_side: Pair = (0.05, 0.01)  # share of the neighbors on the wrong side of the line
    color_edge_ridge: float = 0.1  # of the regression of the line

    # memory
    block_size: int = 512  # points per block: a block fits into a core's cache


CONSTANTS = Constants()
