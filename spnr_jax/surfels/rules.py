"""The numbers of the surfels' geometry, in one record.

Lengths are in spacings of the points, weights count neighbors (a neighbor at its point's own place weighs 1), cosines
and shares have no unit.  Lengths in units of the box, whose half diagonal is 1, are marked.
"""

from dataclasses import dataclass

NEIGHBORS = 20  # of a point, itself among them
Pair = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Rules:
    """Limits and standard deviations of the estimates; one that fades has where it begins and where it is whole."""

    # spacing
    first_disc: int = 6  # neighbors in the disc whose area gives the first spacing
    least_spacing: float = 1e-5  # of the box, for points that coincide
    alone: float = 0.1  # of the box, the spacing of a single point
    own_disc: float = 5.5  # weight of the neighbors in the disc whose area gives the spacing
    own_share: float = 0.6  # of the weight of the layer's neighbors, that disc's at most
    bounds: Pair = (0.5, 1.6)  # of the spacing over the first one
    smoothed: int = 9  # neighbors over which spacing and visibility are averaged
    near: float = 1.2  # standard deviation of the weight of a neighbor's distance

    # layers: a plane that two neighbors span, then a quadric
    paired: int = 8  # nearest neighbors whose pairs span the planes that are tried
    sliver: float = 0.2  # sine between two of them from which on they span a plane
    flat: float = 0.1  # height over a plane at which a point supports it half
    trusted: float = 1.15  # weight of the plane of least squares: it is the better one where points are noisy
    rounds: int = 4  # of the quadric's fit
    slope_ridge: float = 1e-3  # added to the normal equations
    bend_ridge: float = 0.1  # added for curvatures
    mixed_ridge: float = 0.05  # added for the mixed curvature: half, so that no axes are preferred
    step_ridge: float = 0.01  # added for a step between two colors
    start: float = 0.12  # standard deviation of a neighbor's height in the first round
    scales: Pair = (0.04, 0.3)  # least and most standard deviation of the height later
    spreads: float = 2.0  # this deviation over the mean height of those that count
    loose: float = 2.0  # deviation of the layer that colors and spacings come from, over that of the fit
    apart: float = 3.0  # deviations from which on a neighbor is of another layer
    parallel: float = 0.8  # cosine between normals of layers that lie above each other

    # sheets: of two skins nearer than a layer is thick, that of the point's color
    like: float = 0.1  # between square roots of linear colors, standard deviation of the weight as of one color
    sheet_scale: float = 0.02  # least standard deviation of the height where colors tell sheets apart
    agreed: float = 0.3  # share of the neighbors of a like color that are certain, from which on a point is believed
    # may be two sheets, are certainly: the step over their thickness, the share of what is known of it that no slope
    # or curvature explains, neighbors of each color, the step over its standard error
    step_high: Pair = (1.5, 3.0)
    step_known: Pair = (0.3, 0.7)
    step_points: Pair = (1.0, 2.0)
    step_significant: Pair = (3.0, 6.0)

    # sides
    wall: float = 1.5  # height within which another layer is the other side of a wall
    wall_vote: float = 3.0  # weight of the wall's vote
    turn: float = 0.5  # lean against a given normal from which it is turned
    evidence: float = 1.0  # votes that a lean is measured against: few of them are none
    sure_side: Pair = (0.15, 0.45)  # lean of the votes from which a side begins to count, and counts whole
    bounds_seen: Pair = (0.5, 2.0)  # of a point's spacing over the median one, where directions look at it
    leak: float = 0.02  # weight of a one-sided disc from behind: better than a hole

    # ends of discs
    rim_within: float = 2.2  # distance of the neighbors that tell where a layer ends
    sharp: float = 0.75  # cosine between normals below which two faces meet at an edge
    steep: float = 0.3  # sine between normals above which a plane cuts a disc
    edge: float = 0.1  # that a disc goes beyond the line where another face cuts it
    aligned: float = 0.8  # cosine between the way to such a line and one of a disc's four ways
    beyond: float = 0.25  # that a surface goes beyond the last point of its layer
    far: float = 4.0  # where a disc without an end ends

    # gaps between random points
    even: float = 0.62  # median distance to the next point from which on points are spread evenly: gaps are holes
    widest_gap: float = 2.2  # radius of the widest gap that is bridged
    same_place: float = 5e-7  # half the square of a distance, below which a point is the same
    bridged: float = 0.95  # from a disc to the middle of a gap, at most

    # colors
    border_within: float = 1.6  # standard deviation of the weight of a neighbor beside a border
    border_least: float = 0.01  # weight from which on a neighbor's place bounds the line
    contrast: Pair = (0.06, 0.16)  # between the two colors, in square roots of linear ones
    parted: Pair = (0.8, 0.9)  # share of the colors' variance that is between the two
    far_share: Pair = (0.03, 0.06)  # of the neighbors beyond the line
    wrong_side: Pair = (0.05, 0.01)  # share of the neighbors on the wrong side of the line
    border_ridge: float = 0.1  # of the line's regression

    # memory
    block: int = 512  # points that are worked on at once: they stay in a core's cache


RULES = Rules()
