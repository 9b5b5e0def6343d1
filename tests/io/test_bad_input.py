"""Bad files end in one line that names the file. Nothing is written, and headers cannot claim memory."""

import json
import os
import pickle
import struct
import tracemalloc
import zipfile
import zlib
from collections import OrderedDict
from io import BytesIO
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import torch
from PIL import Image
from safetensors.torch import save, save_file

from neuma_lib.capture.masks.regions import read_mask
from neuma_lib.capture.pictures import read_picture
from neuma_lib.errors import InputError
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.files import read_json
from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import list_images, read_image_set
from neuma_lib.io.laws import load_law, load_prior
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_reconstruction, save_particles, with_motion
from neuma_lib.io.weights import read_torch, read_weights
from tests.support.splat_files import ball

pytestmark = pytest.mark.core

HUGE = 2**26  # zeros that archives below hide [bytes]
MEMORY = HUGE / 2
"""Maximum of a refusal [bytes]. The headers below claim 64 MiB to 22 TiB."""


def refused(read, path, message=None):
    """The call raises InputError of one line that names the file, takes little memory and writes nothing."""
    before = {p: p.read_bytes() for p in path.parent.rglob("*") if p.is_file()}
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match=message) as caught:
            read(path)
        assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()
    text = str(caught.value)
    assert path.name in text and len(text.splitlines()) == 1 and len(text) < 1000
    assert {p: p.read_bytes() for p in path.parent.rglob("*") if p.is_file()} == before


# ---- PLY

XYZ = "property float x\nproperty float y\nproperty float z\n"
CORNERS = "property list uchar int vertex_indices\n"


def ply(body, form="binary_little_endian", end="end_header\n", data=b"\0" * 36):
    return f"ply\nformat {form} 1.0\n{body}{end}".encode() + data


PLY = {
    "empty": b"",
    "no end of the header": b"ply\nformat ascii 1.0\n" + b"comment\n" * 20000,
    "negative count": ply(f"element vertex -3\n{XYZ}"),
    "count in words": ply(f"element vertex three\n{XYZ}"),
    "count of 10^4300": ply(f"element vertex 1{'0' * 5000}\n{XYZ}"),
    "nothing after end_header": ply(f"element vertex 0\n{XYZ}", end="end_header", data=b""),
    "no new line after end_header": ply(f"element vertex 3\n{XYZ}", end="end_header"),
    "claims a terabyte": ply(f"element vertex {2**37}\n{XYZ}"),
    "claims a terabyte of text": ply(f"element vertex {2**37}\n{XYZ}", "ascii"),
    "claims a terabyte of faces": ply(f"element vertex 3\n{XYZ}element face {2**37}\n{CORNERS}"),
    "rows without properties": ply(f"element vertex {2**60}\n"),
    "truncated": ply(f"element vertex 4\n{XYZ}"),
    "truncated text": ply(f"element vertex 4\n{XYZ}", "ascii", data=b"0 0 0\n" * 3 + b" " * 99),
    "text that is no number": ply(f"element vertex 1\n{XYZ}", "ascii", data=b"0 zero 0\n"),
    "bytes that are no text": ply(f"element vertex 1\n{XYZ}", "ascii", data=b"\xff\xff\xff\xff\xff\xff\n"),
    "unknown type": ply("element vertex 3\nproperty quaternion x\n"),
    "two elements of one name": ply(f"element vertex 1\n{XYZ}element vertex 1\n{XYZ}"),
    "vertices with a list": ply("element vertex 3\nproperty list uchar int vertex_indices\n"),
    "a list elsewhere": ply(
        f"element vertex 1\n{XYZ}element strip 1\nproperty list int int vertex_indices\n"
    ),
    "faces without corners": ply(f"element vertex 1\n{XYZ}element face 1\nproperty float x\n"),
    "faces of 4 corners": ply(
        f"element vertex 0\n{XYZ}element face 1\n{CORNERS}", data=struct.pack("<B4i", 4, 0, 1, 2, 3)
    ),
    "faces of 4 corners in text": ply(
        f"element vertex 0\n{XYZ}element face 1\n{CORNERS}", "ascii", data=b"4 0 1 2 3\n"
    ),
    "no vertices": ply("", data=b""),
}


@pytest.mark.parametrize("content", PLY.values(), ids=PLY)
@pytest.mark.parametrize("read", [read_mesh, load_gaussians])
def test_ply(tmp_path, read, content):
    path = tmp_path / "bad.ply"
    path.write_bytes(content)
    refused(read, path)


# ---- HDF5


def soft_link(file, folder):
    file["x"] = h5py.SoftLink("/other")
    file["other"] = np.zeros((2, 3))


def external_storage(file, folder):
    (folder / "secret").write_bytes(b"\1" * 48)
    file.create_dataset("x", (2, 3), "f8", external=[(folder / "secret", 0, 48)])


def external_link(file, folder):
    with h5py.File(folder / "secret.h5", "w") as other:
        other["x"] = np.zeros((2, 3))
    file["x"] = h5py.ExternalLink(str(folder / "secret.h5"), "x")


def virtual(file, folder):
    layout = h5py.VirtualLayout((2, 3), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "secret.h5"), "x", (2, 3))
    file.create_virtual_dataset("x", layout)


def incomplete(file, folder):
    data = file.create_dataset("x", (2**20, 3), "f4", chunks=(1024, 3), compression="gzip")
    data[:1024] = np.random.default_rng(0).random((1024, 3))


def attribute(value):
    def change(file, folder):
        file["x"] = np.zeros((2, 3))
        file.attrs["dt"] = value

    return change


def twice_packed(file, folder):
    """64 MiB of zeros in a few bytes, in a chunk of 8 bytes."""
    packed = zlib.compress(zlib.compress(bytes(HUGE), 9), 9)
    create = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    create.set_chunk((2, 3))
    for _ in range(2):
        create.set_deflate(9)
    space = h5py.h5s.create_simple((2, 3))
    data = h5py.h5d.create(file.id, b"x", h5py.h5t.NATIVE_DOUBLE, space, create)
    data.write_direct_chunk((0, 0), packed)


HDF5 = {
    "two gzip filters": twice_packed,
    "a filter": lambda file, folder: file.create_dataset("x", data=np.ones((2, 3)), shuffle=True),
    "another shape": lambda file, folder: file.update(x=np.zeros((2, 4))),
    "shapes that do not match": lambda file, folder: file.update(x=np.zeros((2, 3)), vol0=np.ones(3)),
    "frames that are not integers": lambda file, folder: file.update(x=np.zeros((2, 3)), frames=np.zeros(1)),
    "negative frames": lambda file, folder: file.update(x=np.zeros((2, 3)), frames=np.array([-1])),
    "external link": external_link,
    "soft link": soft_link,
    "dangling link": lambda file, folder: file.update(x=h5py.SoftLink("/absent")),
    "external storage": external_storage,
    "virtual dataset": virtual,
    "a group": lambda file, folder: file.create_group("x"),
    "a type": lambda file, folder: file.update(x=np.dtype("f8")),
    "a text": lambda file, folder: file.update(x="text"),
    "texts of any length": lambda file, folder: file.create_dataset("x", (2,), h5py.string_dtype()),
    "records": lambda file, folder: file.update(x=np.zeros(2, [("a", "f4")])),
    "complex numbers": lambda file, folder: file.update(x=np.zeros(2, complex)),
    "references": lambda file, folder: file.create_dataset("x", (2,), h5py.ref_dtype),
    "nothing": lambda file, folder: file.update(x=h5py.Empty("f4")),
    "claims 22 TiB": lambda file, folder: file.create_dataset("x", (22 * 2**40,), "u1"),
    "claims 22 TiB in chunks": lambda file, folder: file.create_dataset(
        "x", (22 * 2**40,), "u1", chunks=(2**30,), compression="gzip"
    ),
    "chunks that were never written": incomplete,
    "an infinite number": lambda file, folder: file.update(x=np.array([1, np.inf])),
    "an attribute that is an array": attribute(np.zeros(9)),
}


@pytest.mark.parametrize("change", HDF5.values(), ids=HDF5)
def test_hdf5(tmp_path, change):
    path = tmp_path / "bad.h5"
    with h5py.File(path, "w") as file:
        change(file, tmp_path)
    refused(lambda p: read_arrays(p, required=("x",)), path)


def test_other_datasets_are_not_read(tmp_path):
    path = tmp_path / "more.h5"
    with h5py.File(path, "w") as file:
        external_link(file, tmp_path)
        file["vol0"], file["foreign"] = np.ones(3), h5py.SoftLink("/absent")
    assert set(read_arrays(path, only=("vol0",))[0]) == {"vol0"}


def test_a_heap_of_texts_without_end(tmp_path):
    """HDF5 does not return from a free space of size 0."""
    path = tmp_path / "bad.h5"
    write_arrays(path, {"x": np.zeros((2, 3))}, {"title": "text"})
    content = bytearray(path.read_bytes())
    at = content.index(b"GCOL") + 16
    while index := struct.unpack_from("<H", content, at)[0]:
        assert index < 10
        at += 16 + 8 * -(-struct.unpack_from("<Q", content, at + 8)[0] // 8)
    content[at + 8 : at + 16] = bytes(8)
    path.write_bytes(content)
    refused(read_arrays, path, "damaged")


def test_binding(tmp_path):
    """Rows and indices that would make a kernel read foreign memory."""
    valid = {"indptr": np.array([0, 2, 3]), "indices": np.array([0, 3, 2]), "values": np.ones(3)}
    save_gaussians(tmp_path / "gaussians.ply", ball(2))
    save_particles(tmp_path / "particles.h5", torch.rand(4, 3), torch.ones(4), {})
    path = tmp_path / "binding.h5"

    def read(path):
        return load_reconstruction(path.with_name("particles.h5"), path, path.with_name("gaussians.ply"), 1.0)

    write_arrays(path, valid, {"gaussians": 2, "particles": 4})
    assert read(path).binding.indices.tolist() == [0, 3, 2]
    for change in (
        {"indices": np.array([0, 4, 2])},
        {"indices": np.array([0, -1, 2])},
        {"indices": np.array([0.0, 1.0, 2.0])},
        {"indices": np.array([0, 1])},
        {"indptr": np.array([0, 2, 2**40])},
        {"indptr": np.array([0, 4, 3])},
        {"indptr": np.array([1, 2, 3])},
        {"indptr": np.array([0, 3])},
        {"values": np.ones(2)},
    ):
        write_arrays(path, valid | change, {"gaussians": 2, "particles": 4})
        refused(read, path)


@pytest.mark.parametrize("content", [b"", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n" + bytes(300)])
def test_other_files_than_hdf5(tmp_path, content):
    path = tmp_path / "bad.h5"
    path.write_bytes(content)
    refused(read_arrays, path)


# ---- lists of images and images


def picture(kind="PNG", size=(16, 12), **options):
    file = BytesIO()
    image = Image.new("RGBA", size, (1, 2, 3, 255))
    (image.convert("RGB") if kind == "JPEG" else image).save(file, kind, **options)
    return file.getvalue()


def image_list():
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "view": 0, "step": 0}
    return {"fl_x": 20.0, "cx": 8.0, "w": 16, "h": 12, "frames": [frame]}


def with_frame(**changes):
    data = image_list()
    data["frames"][0].update(changes)
    return json.dumps(data)


def with_top(**changes):
    return json.dumps({**image_list(), **changes})


LISTS = {
    **{f"file_path {value!r}": with_frame(file_path=value) for value in (5, None, ["a.png"], {}, "", "a\nb", "\0")},
    "a long file_path": with_frame(file_path="a" * 300),
    **{f"view {value!r}": with_frame(view=value) for value in ("5", None, 5.5, [5], True, {})},
    **{f"step {value!r}": with_frame(step=value) for value in ("5", None, 5.5, [5])},
    **{f"frames {value!r}": with_top(frames=value) for value in (5, "text", None, [5], [None], ["a"], {}, [[]])},
    **{f"w {value!r}": with_top(w=value) for value in ("16", 10**6, 0, -1, True, [16], 10**400)},
    "fl_x of text": with_top(fl_x="20"),
    "a million by a million": with_top(w=10**6, h=10**6),
    "sha256 5": with_frame(sha256=5),
    "matrix of text": with_frame(transform_matrix=[["a"] * 4] * 4),
    "matrix of numbers in text": with_frame(transform_matrix=np.eye(4).astype(str).tolist()),
    "ragged matrix": with_frame(transform_matrix=[[1, 0, 0, 0], [0, 1]]),
    "matrix of huge numbers": with_frame(transform_matrix=[[10**400] * 4] * 4),
    "nested matrix": with_frame(transform_matrix="NESTED").replace('"NESTED"', "[" * 500 + "]" * 500),
    "deep nesting": "[" * 100_000,
    "NaN": with_frame(transform_matrix=[[float("nan")] * 4] * 4),
    "Infinity": with_top(fl_x=float("inf")),
    "overflow": with_top(fl_x=1).replace('"fl_x": 1,', '"fl_x": 1e999,'),
    "not UTF-8": b"\xff\xfe\x00",
    "a number": "5",
    "released: entry 5": "[5]",
    "released: file_path null": '[{"file_path": null, "c2w": [], "intrinsic": []}]',
    "released: c2w of text": '[{"file_path": "a.png", "c2w": [["a"]], "intrinsic": [[1]]}]',
}  # fmt: skip


@pytest.mark.parametrize("content", LISTS.values(), ids=LISTS)
def test_lists_of_images(tmp_path, content):
    (tmp_path / "a.png").write_bytes(picture())
    path = tmp_path / "bad.json"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(read_image_set, path)
    refused(lambda p: list_images(p, p.parent / "new" / "transforms.json"), path)


MOTION = {"v0": [0, -1, 0], "angular_velocity": [0, 0, 0], "centre": [0.5, 0.5, 0.5]}


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ({"v0": MOTION["v0"]}, "angular_velocity"),
        ({**MOTION, "v0": "fast"}, "v0: must be a list of 3"),
        ({**MOTION, "v0": [0, "1", 0]}, r"v0\[1\]: must be a number"),
        ({**MOTION, "v0": [0, True, 0]}, r"v0\[1\]: must be a number"),
        ({**MOTION, "centre": [1, 2]}, "centre: must be a list of 3 or null"),
        ([MOTION], "must be an object"),
        ('{"v0": [0, 0, 0], "v0": [1, 1, 1]}', "v0.*twice"),
        ('{"v0": [0, 0, 1e999]}', "1e999"),
    ],
)
def test_json_of_stages(tmp_path, text, key):
    path = tmp_path / "velocity.json"
    path.write_text(text if isinstance(text, str) else json.dumps(text))
    refused(lambda p: with_motion(SimpleNamespace(state=lambda *_: None), p), path, key)


def test_missing_entries_are_named_in_any_file(tmp_path):
    path = tmp_path / "any.json"
    path.write_text('{"a": {"b": [{"c": 1}]}}')
    assert read_json(path) == {"a": {"b": [{"c": 1}]}}
    refused(lambda p: read_json(p)["a"]["b"][0]["d"], path, "'d'")


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width, height, rows):
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


IMAGES = {
    "empty": b"",
    "text": b"no image",
    "a GIF": picture("GIF"),
    "a TIFF": picture("TIFF"),
    "an EPS": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 16 12\n%%EndComments\n",
    "a JPEG, which has no alpha": picture("JPEG"),
    "a bomb": png(7000, 7000, bytes(10)),
    "claims 10^6 x 10^6": png(10**6, 10**6, bytes(10)),
    "of another size": picture(size=(17, 12)),
    "truncated": picture()[:-20],
    "rows that are missing": png(16, 12, bytes(10)),
    "a text chunk that unpacks to 64 MiB": picture()[:33]
    + chunk(b"zTXt", b"a\0\0" + zlib.compress(bytes(HUGE), 1))
    + picture()[33:],
}


@pytest.mark.parametrize("content", IMAGES.values(), ids=IMAGES)
def test_images(tmp_path, content):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    (tmp_path / "transforms.json").write_text(json.dumps(image_list()))
    refused(lambda p: read_image_set(p.parent / "transforms.json"), path)


# ---- weights


class Command:
    """Runs a command when it is unpickled."""

    def __reduce__(self):
        return print, ("unpickled",)


class Zeros:
    """Takes memory when it is unpickled, which torch permits."""

    def __reduce__(self):
        return bytearray, (HUGE,)


def torch_file(content):
    file = BytesIO()
    torch.save(content, file)
    return file.getvalue()


def denied(archive):
    """The same archive with headers that claim 9 bytes where there are 64 MiB."""
    return archive.replace(struct.pack("<L", HUGE), struct.pack("<L", 9))


def deflated(content, part="/data/"):
    """The same archive, but with 64 MiB in a few bytes."""
    file = BytesIO()
    with zipfile.ZipFile(BytesIO(torch_file(content))) as old, zipfile.ZipFile(file, "w") as new:
        for info in old.infolist():
            data = bytes(HUGE) if part in info.filename else old.read(info)
            new.writestr(info.filename, data, zipfile.ZIP_DEFLATED)
    return file.getvalue()


def pickled(opcodes):
    """The same archive with another pickle."""
    file = BytesIO()
    with (
        zipfile.ZipFile(BytesIO(torch_file({"a": torch.zeros(2)}))) as old,
        zipfile.ZipFile(file, "w") as new,
    ):
        for info in old.infolist():
            new.writestr(info.filename, opcodes if info.filename.endswith(".pkl") else old.read(info))
    return file.getvalue()


NESTED_TUPLES = b")" + b"".join(b"q" + bytes([k]) + b"h" + bytes([k]) + b"\x86" for k in range(60))
"""A tuple of two tuples, which are the same, and so on: 2^60 in 300 bytes."""
ENCODED = (
    b"\x80\x02"
    + 28 * b"c_codecs\nencode\n"
    + b"X\1\0\0\0aX\5\0\0\0ascii\x86R"
    + 27 * b"X\3\0\0\0hex\x86R"
    + b"."
)
"""Hexadecimal digits of digits: 2^27 bytes from one."""
LONGER = torch_file({"a": torch.zeros(2)}).replace(b"K\x02tq", b"K\x63tq")
"""A tensor of 99 numbers that stores 2."""


def law_parts(weight):
    names = ("layers.0.fc.weight", "layers.1.fc.weight", "final_layer.fc.weight")
    return {part: dict.fromkeys(names, weight) for part in ("elasticity", "plasticity")}


WITHOUT_MEMORY = torch_file(law_parts(torch.zeros(1, dtype=torch.float64).expand(2**20, 2**20)))
TORCH = {
    "empty": b"",
    "text": b"no weights",
    "a pickle": pickle.dumps({"elasticity": Command()}),
    "a command": torch_file({"elasticity": Command(), "plasticity": Command()}),
    "zeros on request": torch_file({"elasticity": Zeros()}),
    "a list": torch_file([1, 2]),
    "parts that are numbers": torch_file({"elasticity": 5, "plasticity": 5}),
    "weights that are numbers": torch_file(law_parts(5)),
    "weights that are text": torch_file(law_parts("text")),
    "weights of other shapes": torch_file(law_parts(torch.zeros(3))),
    "weights without memory": WITHOUT_MEMORY,
    "truncated": torch_file(law_parts(torch.zeros(64, 64)))[:-200],
    "64 MiB deflated": deflated(law_parts(torch.zeros(2))),
    "64 MiB deflated, which its header denies": denied(deflated(law_parts(torch.zeros(2)), "data.pkl")),
    "an ordered list": torch_file(OrderedDict(a=1)),
    "an encoder": pickled(ENCODED),
    "a key of nested tuples": pickled(b"\x80\x02}" + NESTED_TUPLES + b"K\1s."),
    "a tensor that is longer than its storage": LONGER,
    "nested tuples in DATA.PKL": pickled(b"\x80\x02}" + NESTED_TUPLES + b"K\1s.").replace(
        b"data.pkl", b"DATA.PKL"
    ),
}


@pytest.mark.parametrize("content", TORCH.values(), ids=TORCH)
def test_torch_files(tmp_path, content, capsys):
    path = tmp_path / "bad.pt"
    path.write_bytes(content)
    refused(load_prior, path)
    if content in (LONGER, WITHOUT_MEMORY):
        refused(read_torch, path)
    refused(lambda p: Checkpoint(p, {"a": 1}).load(), path, "rm ")
    assert "unpickled" not in capsys.readouterr().out


def safetensors_header(**entries):
    text = json.dumps(entries).encode()
    return struct.pack("<Q", len(text)) + text


SAFETENSORS = {
    "empty": b"",
    "a header of 2^60 bytes": struct.pack("<Q", 2**60) + b"{}",
    "claims 22 TiB": safetensors_header(x={"dtype": "U8", "shape": [22 * 2**40], "data_offsets": [0, 22 * 2**40]}),
    "offsets beyond the end": safetensors_header(x={"dtype": "U8", "shape": [9], "data_offsets": [0, 9]}),
    "a shape of text": safetensors_header(x={"dtype": "U8", "shape": "9", "data_offsets": [0, 9]}),
    "metadata that is no JSON": save({"x": torch.zeros(2)}, {"neuma": "{"}),
    "metadata that is a list": save({"x": torch.zeros(2)}, {"neuma": "[]"}),
    "metadata nested deep": save({"x": torch.zeros(2)}, {"neuma": "[" * 100_000}),
    "infinite": save({"x": torch.full((2,), torch.inf)}),
}  # fmt: skip


@pytest.mark.parametrize("content", SAFETENSORS.values(), ids=SAFETENSORS)
def test_safetensors(tmp_path, content):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(content)
    refused(read_weights, path)


LAWS = {
    "no rank": {},
    "rank of text": {"rank": "4", "alpha": 4.0},
    "rank below one": {"rank": -4, "alpha": 4.0},
    "rank of a million": {"rank": 10**6, "alpha": 4.0},
    "alpha of text": {"rank": 4, "alpha": "4"},
    "alpha that is missing": {"rank": 4, "alpha": None},
    "other tensors": {"rank": 4, "alpha": 4.0},
}


@pytest.mark.parametrize("metadata", LAWS.values(), ids=LAWS)
def test_adaptors(tmp_path, metadata):
    from neuma_lib.mechanics.neural import neural_law

    save_file(neural_law(seed=0).prior_state(), tmp_path / "prior.safetensors")
    path = tmp_path / "bad.safetensors"
    save_file({"x": torch.zeros(2)}, path, {"neuma": json.dumps(metadata)})
    refused(lambda p: load_law(tmp_path / "prior.safetensors", p), path)


# ---- Cameras and pictures


def camera_list(path, change):
    """A transforms.json of one image, changed by ``change(data, frame)``."""
    Image.fromarray(np.full((4, 4, 4), 255, np.uint8)).save(path.parent / "0.png")
    frame = {"file_path": "0.png", "transform_matrix": np.eye(4).tolist(), "view": 0, "step": 0}
    data = {"camera_angle_x": 0.7, "frames": [frame]}
    change(data, frame)
    path.write_text(json.dumps(data))
    return path


def entry(row, column, value):
    def change(data, frame):
        frame["transform_matrix"][row][column] = value

    return change


CAMERAS = {
    "mirrored": entry(0, 0, -1),
    "last row": entry(3, 0, 0.5),
    "homogeneous scale": entry(3, 3, 2),
    "not orthonormal": entry(0, 1, 0.1),
    "far away": entry(0, 3, 1e308),
    "field of view of pi": lambda data, frame: data.update(camera_angle_x=np.pi),
    "field of view of 0": lambda data, frame: data.update(camera_angle_x=0),
    "focal length": lambda data, frame: data.update(fl_x=1e308),
    "focal length near zero": lambda data, frame: data.update(fl_x=1e-300),
    "same image 20 times": lambda data, frame: data.update(frames=[frame] * 20),
    "same image by another path": lambda data, frame: data["frames"].append(
        {**frame, "file_path": "./0.png"}
    ),
}


@pytest.mark.parametrize("change", CAMERAS.values(), ids=CAMERAS)
def test_cameras(tmp_path, change):
    refused(read_image_set, camera_list(tmp_path / "transforms.json", change))


@pytest.mark.parametrize("row, column, value", [(0, 0, -1), (3, 0, 0.5), (0, 3, 1e308)])
def test_released_cameras(tmp_path, row, column, value):
    pose = np.eye(4)
    pose[row, column] = value
    path = tmp_path / "data_dynamic.json"
    path.write_text(
        json.dumps(
            [{"file_path": "r_0_0.png", "c2w": pose.tolist(), "intrinsic": [[9, 0, 2], [0, 9, 2], [0, 0, 1]]}]
        )
    )
    refused(read_image_set, path, "transform_matrix")


GREY16 = Image.fromarray(np.full((4, 4), 300, np.uint16))
PICTURES = {
    "16 bits": lambda path: GREY16.save(path),
    "animation": lambda path: Image.new("RGB", (4, 4)).save(
        path, save_all=True, append_images=[Image.new("RGB", (4, 4), "red")]
    ),
    "pipe": os.mkfifo,
    "folder": lambda path: path.mkdir(),
    "sparse file": lambda path: os.truncate(os.open(path, os.O_CREAT | os.O_WRONLY), 2**32),
    "60,000 x 60,000 pixels": lambda path: path.write_bytes(huge_png()),
}


def huge_png():
    """Header of a PNG."""
    chunks = [b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0), b"IDAT", b"IEND"]
    body = b"".join(struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + body


@pytest.mark.parametrize("write", PICTURES.values(), ids=PICTURES)
@pytest.mark.parametrize(
    "read", [read_picture, lambda path: read_mask(path, (4, 4))], ids=["picture", "mask"]
)
def test_pictures(tmp_path, read, write):
    path = tmp_path / "picture.png"
    write(path)
    with pytest.raises(InputError, match="picture.png") as caught:
        read(path)
    assert len(str(caught.value).splitlines()) == 1


def deep_png(colours):
    """An RGB image of 16 bits per channel, which Pillow cannot write."""
    rows = b"".join(b"\0" + row.tobytes() for row in (colours.astype(">u2") * 257))
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", colours.shape[1], colours.shape[0], 16, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    "mode, kind",
    [("1", "PNG"), ("P", "PNG"), ("LA", "PNG"), ("RGB", "PNG"), ("CMYK", "JPEG"), ("deep", "PNG")],
)
def test_all_kinds_of_pictures_keep_their_colours(tmp_path, mode, kind):
    """Black, white and grey to within what JPEG loses."""
    path = tmp_path / f"picture.{kind.lower()}"
    grey = 255 if mode == "1" else 128
    colours = np.repeat(np.kron([[0, 255], [grey, 255]], np.ones((8, 8)))[..., None], 3, axis=2).astype(
        np.uint8
    )
    if mode == "deep":
        path.write_bytes(deep_png(colours))
    else:
        image = Image.fromarray(colours)
        (image.quantize(8) if mode == "P" else image.convert(mode)).save(path, kind, quality=100)
    np.testing.assert_allclose(read_picture(path).astype(int), colours, atol=4)
