"""Input files as Snakemake hands them to scripts, and as users name them."""

from pathlib import Path

from neuma_lib.errors import InputError

COUNTED = ("all_data.json", "camera.json")
"""Lists of images whose frames are counted, not named by simulated steps (`neuma_lib.io.datasets.layouts`)."""


def image_list(place: str, stride: int | None, key: str, stride_key: str) -> str:
    """The list of images that a setting names, itself or by its folder; one that counts frames needs ``stride``.

    Args:
        key, stride_key: the settings, for messages.
    """
    if Path(place).is_dir():
        lists = [name for name in (*COUNTED, "transforms.json") if Path(place, name).is_file()]
        if len(lists) != 1:
            content = " and ".join(lists) or f"none of {', '.join(COUNTED)}, transforms.json"
            raise InputError(key, f"the folder {place} has {content}", "Give the file that lists the images")
        place = f"{place.rstrip('/')}/{lists[0]}"
    if Path(place).name in COUNTED and stride is None:
        raise InputError(
            stride_key, f"missing, but {place} numbers frames", "Give the simulated steps between two frames"
        )
    return place
