"""How sure a mean score is: intervals over objects, and whether one method is better than another on the same objects.

Scores come by object, an array (views,) each; NaN is a view without a score and is left out.  Views of one object are
not independent, so objects are drawn, each with all its views; the mean is over the views of the drawn objects, as in
the tables, so that the interval belongs to the number beside it.

Intervals are percentile bootstraps over `RESAMPLES` draws.  With few objects these are too narrow; the levels are
therefore widened to those that are exact for the mean of normal scores (Hesterberg 2015, "expanded percentile").
Differences between methods are taken view by view, so what makes an object hard for both cancels.  Objects are sorted
before anything is drawn: their order does not matter, bit for bit, and the same scores give the same numbers.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

RESAMPLES = 10_000
LEVEL = 0.95
EXACT = 13  # objects up to which all 2^objects sign flips are tried: fewer than RESAMPLES
ROUNDING = 1e-9  # share of the largest possible sum within which two sums count as equal


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Mean of one method minus another's, its interval, and the p-value of no difference.

    The interval is the main result: it says how large the difference may be, in units of the metric, where a p-value
    only says whether there is one.  Nothing is known from fewer than two objects: None.
    """

    mean: float
    interval: tuple[float, float] | None
    p_value: float | None


def interval(scores: Sequence[np.ndarray], seed: int = 0) -> tuple[float, float] | None:
    """Ends of the bootstrap interval of the mean over all views; None of fewer than two objects with a score."""
    sums, counts = _by_object(scores)
    if len(sums) < 2:
        return None
    drawn = _draws(len(sums), seed)
    means = (drawn @ sums) / (drawn @ counts)
    low, high = np.quantile(means, _levels(len(sums)))
    return float(low), float(high)


def difference(first: Sequence[np.ndarray], second: Sequence[np.ndarray], seed: int = 0) -> Difference | None:
    """The first method minus the second on the same objects and views; None if no view has both scores."""
    changes = [np.asarray(a, np.float64) - np.asarray(b, np.float64) for a, b in zip(first, second, strict=True)]
    sums, counts = _by_object(changes)
    if not len(sums):
        return None
    p_value = _sign_flip_test(sums, seed) if len(sums) > 1 else None
    return Difference(mean=float(sums.sum() / counts.sum()), interval=interval(changes, seed), p_value=p_value)


def _by_object(scores: Sequence[np.ndarray]) -> tuple[Float[np.ndarray, " objects"], Int[np.ndarray, " objects"]]:
    """Sum and number of the scores of each object that has any, sorted."""
    pairs = sorted((float(np.nansum(x, dtype=np.float64)), int(np.sum(~np.isnan(x)))) for x in scores)
    sums, counts = (np.array(column) for column in zip(*pairs, strict=True))
    return sums[counts > 0], counts[counts > 0]


@lru_cache(maxsize=8)  # every metric of every method draws from the same number of objects
def _draws(objects: int, seed: int) -> Int[np.ndarray, "resamples objects"]:
    """How often each object is drawn in each resample."""
    return np.random.default_rng(seed).multinomial(objects, np.full(objects, 1 / objects), RESAMPLES)


def _levels(objects: int) -> tuple[float, float]:
    """Quantiles of the resampled means that bound the interval: 0.025 and 0.975 but for the correction of few objects.

    The bootstrap's spread is sqrt((n - 1) / n) times the standard error, and its shape normal instead of Student's t.
    """
    from scipy.stats import norm, t  # here, so that importing the package stays light

    quantile = np.sqrt(objects / (objects - 1)) * t.ppf((1 - LEVEL) / 2, objects - 1)
    low = float(norm.cdf(quantile))
    return low, 1 - low


def _sign_flip_test(sums: Float[np.ndarray, " objects"], seed: int) -> float:
    """Two-sided p-value of the differences' sum if each object might as well have had the other sign.

    Randomisation of the mean that the tables show, not of its ranks; exact up to EXACT objects, else over random flips.
    """
    objects = len(sums)
    if objects <= EXACT:
        signs = np.array(list(itertools.product((-1, 1), repeat=objects)))
    else:
        signs = np.random.default_rng(seed).choice((-1, 1), (RESAMPLES, objects))
    extreme = np.abs(signs @ sums) >= abs(sums.sum()) - ROUNDING * np.abs(sums).sum()
    if objects <= EXACT:
        return float(extreme.mean())
    return float((1 + extreme.sum()) / (1 + RESAMPLES))
