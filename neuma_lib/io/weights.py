"""Tensors on disk: safetensors with metadata, and files of torch.save, which are read without executing code."""

import io
import json
import math
import pickletools
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save

from neuma_lib.io.files import atomic, existing, one_line, parse_json, reading, zip_member


def write_weights(path: str | Path, tensors: Mapping[str, torch.Tensor], metadata: Mapping[str, Any]) -> None:
    """Write tensors to safetensors, with metadata as one JSON text (the order of the header is not fixed)."""
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    content = save(kept, metadata={"neuma": json.dumps(metadata, sort_keys=True)})
    with atomic(path) as partial:
        partial.write_bytes(content)  # save_file sets permissions that exclude other users


def read_weights(path: str | Path) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
    """Read tensors and metadata from safetensors.

    Raises:
        InputError: missing, truncated or foreign file, or values that are not finite.
    """
    path = existing(path)
    with reading(path, "safetensors"), safe_open(path, framework="pt", device="cpu") as file:
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        metadata = parse_json((file.metadata() or {}).get("neuma", "{}"), f"{path}: metadata")
        if not isinstance(metadata, dict):
            raise ValueError("the metadata are not a JSON object")
        for name, tensor in tensors.items():
            if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
                raise ValueError(f"{name} is not finite")
        return tensors, metadata


def read_torch(path: str | Path) -> Any:
    """Content of a file of torch.save: tensors, numbers and texts in plain containers; nothing else is unpickled.

    Raises:
        InputError: missing, damaged or foreign file, or one that would need more memory than its size.
    """
    path = existing(path)
    with reading(path, "a torch file of plain tensors"):
        size = path.stat().st_size
        with zipfile.ZipFile(path) as archive:  # torch writes uncompressed ZIP archives since 1.6
            members = archive.infolist()
            sizes = {member.filename.partition("/")[2]: member.file_size for member in members}
            if len(sizes) < len(members) or sum(sizes.values()) > size:
                raise ValueError("two of its members have one name, or it claims more data than it has bytes")
            checked = io.BytesIO()  # torch compares names and follows offsets in other ways than zipfile
            with zipfile.ZipFile(checked, "w") as copy:
                for member in members:
                    content = zip_member(archive, member, size)
                    if member.filename.lower().endswith(".pkl"):
                        _check_pickle(content, sizes)
                    copy.writestr(member.filename, content)
        checked.seek(0)
        return torch.load(checked, map_location="cpu", weights_only=True)


_GLOBALS = {"torch._utils _rebuild_tensor_v2", "torch._utils _rebuild_parameter", "collections OrderedDict"}
_STORAGES = {
    f"torch {name}Storage": width
    for width, names in {
        1: ("Byte", "Char", "Bool"), 2: ("Short", "Half", "BFloat16"), 4: ("Int", "Float"), 8: ("Long", "Double")
    }.items()
    for name in names
}  # fmt: skip
"""Bytes of an element."""
_PUT, _GET = {"BINPUT", "LONG_BINPUT"}, {"BINGET", "LONG_BINGET"}
_TUPLES = {"TUPLE", "TUPLE1", "TUPLE2", "TUPLE3", "EMPTY_TUPLE"}
_VALUES = {"BINUNICODE", "SHORT_BINUNICODE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"}
_OPCODES = _PUT | _GET | _TUPLES | _VALUES | {
    "PROTO", "STOP", "MARK", "GLOBAL", "REDUCE", "BUILD", "BINPERSID", "NONE", "NEWTRUE", "NEWFALSE",
    "EMPTY_DICT", "SETITEM", "SETITEMS", "EMPTY_LIST", "APPEND", "APPENDS",
}  # fmt: skip
_MARK = pickletools.markobject


def _check_pickle(content: bytes, sizes: Mapping[str, int]) -> None:
    """Check that a pickle only uses what torch.save writes for plain tensors, from its opcodes.

    Objects that refer to each other can stand for exponentially many, for example as the key of a dict. Their number
    is counted without building them.

    Args:
        sizes: bytes of each storage in the archive.

    Raises:
        ValueError: another opcode or global, too many objects, or a storage that claims another size.
    """
    limit = 1000 + 10 * len(content)
    stack: list[Any] = []  # number of objects in each object, and its value if it is a text, number or tuple
    memo: dict[Any, Any] = {}
    for opcode, argument, _ in pickletools.genops(content):
        name = opcode.name
        if name not in _OPCODES or (name == "GLOBAL" and argument not in _GLOBALS | _STORAGES.keys()):
            raise ValueError(f"it contains {one_line(argument or name)}, not only plain tensors")
        if name in _PUT:
            memo[argument] = stack[-1]
        elif name in _GET:
            stack.append(memo[argument])
        elif name == "MARK":
            stack.append(_MARK)
        elif opcode.stack_after:
            before, taken = opcode.stack_before, []
            if _MARK in before:
                start = len(stack) - 1 - stack[::-1].index(_MARK)
                taken, before = stack[start + 1 :], before[: before.index(_MARK)]
                del stack[start:]
            first = len(stack) - len(before)
            taken = stack[first:] + taken
            del stack[first:]
            values = [value for _, value in taken]
            if name == "REDUCE" and values[0] not in _GLOBALS:
                raise ValueError(f"it calls {one_line(values[0])}")
            if name == "BINPERSID":
                _, kind, key, _, count = values[0]
                if count * _STORAGES[kind] != sizes[f"data/{key}"]:
                    raise ValueError(f"the tensor {one_line(key)} claims another size than it has")
                argument = count
            if name == "REDUCE" and values[0] == "torch._utils _rebuild_tensor_v2":
                stored, _, shape, *_ = values[1]
                if math.prod(shape) > stored:  # by a stride of zero
                    raise ValueError("a tensor has more elements than it stores")
            weight = 1 + sum(number for number, _ in taken)
            if weight > limit:
                raise ValueError("it refers to the same objects too often")
            stack.append((weight, values if name in _TUPLES else argument))
