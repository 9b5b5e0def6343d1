"""Files of voxel radiance fields."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.io.files import one_line
from neuma_lib.io.weights import read_weights, write_weights
from neuma_lib.methods.pac_nerf.field import RadianceField
from neuma_lib.methods.pac_nerf.lattice import Lattice
from neuma_lib.methods.pac_nerf.rendering import Opacity


def save_field(path: str | Path, field: RadianceField, metadata: Mapping[str, Any]) -> None:
    """Write densities, features and network to safetensors, with the lattice, the opacity and more metadata."""
    lattice, opacity = field.lattice, field.opacity
    nodes = {"origin": lattice.origin, "voxel": lattice.voxel, "nodes": lattice.nodes}
    activation = {"initial": opacity.initial, "base_voxel": opacity.base_voxel}
    write_weights(path, field.state_dict(), {**metadata, "lattice": nodes, "opacity": activation})


def load_field(path: str | Path) -> tuple[RadianceField, dict[str, Any]]:
    """A field without gradients, and the metadata of its file. Raises InputError for a wrong or no file."""
    tensors, metadata = read_weights(path)
    try:
        nodes = metadata["lattice"]
        lattice = Lattice(tuple(nodes["origin"]), float(nodes["voxel"]), tuple(nodes["nodes"]))
        field = RadianceField.of_state(lattice, Opacity(**metadata["opacity"]), tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        problem = f"is not a voxel radiance field: {one_line(error)}"
        raise InputError(path, problem, "Run the rule radiance_field again") from None
    return field.requires_grad_(False), metadata
