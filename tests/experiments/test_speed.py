"""What the measured times stand on: the twin is the same network, and ratios are paired."""

import numpy as np
import pytest
from support import twin

from experiments.speed import bench


def test_the_ratio_is_the_median_of_paired_ratios():
    turns = [([1.0, 2.0, 9.0], [4.0] * 3), ([40.0] * 3, [80.0] * 3), ([3.0] * 3, [10.0, 1.0, 30.0])]
    assert bench.paired_ratio(turns) == [0.4, 0.5, 0.5]  # the second round is on a slow machine


def test_a_turn_leaves_its_first_run_out():
    runs = []
    assert len(bench.turn(lambda: runs.append(1), seconds=0)) == bench.FEWEST
    assert len(runs) == bench.FEWEST + 1


def test_our_pytorch_twin_is_the_network_of_the_fixture():
    torch = pytest.importorskip("torch", reason="the extra `bench` is not installed")
    from experiments.speed import twin as torch_twin

    arrays = {name: torch.from_numpy(x) for name, x in twin.load().items() if x.dtype == np.float32}
    generator = torch_twin.Generator(twin.config(twin.load()).model).eval()
    named = {name.removeprefix("param/gen."): x for name, x in arrays.items() if name.startswith("param/gen.")}
    generator.load_state_dict(named, strict=False)
    with torch.inference_mode():
        volume = generator.encode_volume(arrays["in/pos"], arrays["in/mat"])
        image, _ = generator.render_volume(volume, arrays["in/c2w"], arrays["in/focal"])
    for found, theirs in ((volume, arrays["eval/volume"]), (image, arrays["eval/image"])):
        assert (found - theirs).norm() <= 1e-5 * theirs.norm()
