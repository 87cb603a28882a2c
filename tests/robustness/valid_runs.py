"""Valid run folders, data sets, lists and weights, as small as can be: what tests/robustness/test_fuzz.py damages."""

import dataclasses
import functools
import io
import json

import numpy as np
from damage import Files
from valid_files import POINTS, SIZE, VIEWS, numbers

from data_gen.store import layout
from spnr_jax import presets
from spnr_jax.methods import to_dict


def configs() -> list[Files]:
    """The configs of every preset, as a run folder holds them."""
    return [{"config.json": json.dumps(to_dict(make()), indent=2).encode()} for make in presets.PRESETS.values()]


def metric_rows() -> list[Files]:
    """A metrics.jsonl."""
    rows = [{"step": step, "loss": 0.5, "steps_per_second": 2.0} for step in range(5)]
    return [{"metrics.jsonl": "".join(json.dumps(row) + "\n" for row in rows).encode()}]


@functools.cache
def object_files() -> Files:
    """The files of an object of a data set."""
    points = np.zeros(POINTS, layout.POINT_TYPE)
    for i, name in enumerate(layout.POINT_FIELDS):
        points[name] = numbers(POINTS, 11)[:, i] * 0.5
    points["nx"], points["ny"], points["nz"] = 0, 0, 1
    images = (255 * numbers(VIEWS, SIZE, SIZE, 4)).astype(np.uint8)
    poses = np.tile(np.eye(4), (VIEWS, 1, 1))
    record = layout.ObjectRecord(
        points=points,
        transforms=layout.nerf_transforms(poses, SIZE, 40.0, 11.0),
        images=images,
        conditions=images,
        details={"id": "a", "product": "a", "variant": 0, "seeds": {"points": 0}, "source": {"file": "m.obj"}},
    )
    return layout.object_files(record)


def datasets() -> list[Files]:
    """A data set of one object, a seed for each of its files as the one that is hit most."""
    described = {
        "schema_version": layout.SCHEMA_VERSION,
        "settings": {"views": VIEWS, "resolution": SIZE, "points": POINTS},
    }
    files = {f"objects/a/{name}": content for name, content in object_files().items()}
    files |= {"dataset.json": layout.json_text(described).encode()}
    files |= {"splits/train.txt": b"a\n", "splits/val.txt": b"", "splits/test.txt": b""}
    first: tuple[str, ...]
    first = ("objects/a/transforms.json", "objects/a/points.ply", "objects/a/images/000.png", "objects/a/object.json")
    first += ("dataset.json", "splits/train.txt")
    return [{name: files[name]} | files for name in first]


def lists() -> list[Files]:
    """Split files, a test list, and the tables of ABO."""
    import gzip

    table = b"3dmodel_id,path,meshes\na,A/a.glb,1\nb,B/b.glb,2\n"
    return [
        {"splits.json": json.dumps({"train": ["a"], "test": ["b"]}).encode()},
        {"splits.csv": b"id,split\na,train\nb,test\n"},
        {"splits.csv": b"id,synsetId,subSynsetId,modelId,split\n1,1,1,a,train\n2,1,1,b,test\n"},
        {"list.txt": b"a\nb\n"},
        {"3dmodels.csv.gz": gzip.compress(table, mtime=0)},
        {"3dmodels.csv": table},
    ]


def weights() -> list[Files]:
    """Files of weights of very small networks, one of them over surfels."""
    from spnr_jax.config import EncoderConfig, PaperConfig, SamplingConfig, SurfelConfig
    from spnr_jax.training.weights import variable_shapes

    paper = presets.tiny()
    assert isinstance(paper.model, PaperConfig)
    small = dataclasses.replace(
        paper.model, field_width=4,
        encoder=EncoderConfig(
            point_widths=(4,), point_features=4, volume_resolution=8, base_width=4, num_stages=2, num_groups=1
        ),
        sampling=SamplingConfig(num_coarse=2, num_fine=0), render_resolution=16, resize_resolution=16,
        image_resolution=32, upsampler_width=4,
    )  # fmt: skip
    files = []
    surfels = dataclasses.replace(presets.surfels_tiny(), model=SurfelConfig(widths=(4, 6), top=4))
    for config in (dataclasses.replace(paper, model=small), surfels):
        described = np.frombuffer(json.dumps(to_dict(config)).encode(), np.uint8)
        halves = {name: np.zeros(x.shape, np.float16) for name, x in variable_shapes(config).items()}
        stream = io.BytesIO()
        np.savez_compressed(stream, allow_pickle=False, config=described, steps=np.int64(3), **halves)
        files.append({"weights.npz": stream.getvalue()})
    return files
