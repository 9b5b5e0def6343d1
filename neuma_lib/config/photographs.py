"""Settings of the reconstruction from photographs, of different sizes and exposures.

They apply if a transforms.json has the entry ``photographs``, as those of captures have. It can be added to other image
sets: ``"photographs": {"floor": 0.0}``, with the height y of the floor below the object [m], or null.
"""

from neuma_lib.config.base import Section, internal


class PhotographsConfig(Section):
    """Reconstruction from photographs of different sizes and exposures."""

    margin: float = internal(0.1, "margin around a mask, as a fraction of its longer side", ge=0)
    longest: int = internal(400, "maximum length of the longer side of a cropped photograph [px]", ge=32)
    # The surface is what all masks contain, so photographs with wrong masks are omitted.
    agreement: float = internal(
        0.9, "share of masks that contain a point of the reference body", gt=0.5, le=1
    )
    lacking: float = internal(0.1, "share of that body that a mask may lack; 1: no limit", gt=0, le=1)
    min_psnr: float = internal(
        15.0, "PSNR of held-out photographs inside the object below which the reconstruction stops [dB]"
    )
    # Decays to a tenth. 0: equal exposure and white balance.
    gain_rate: float = internal(0.01, "learning rate of the log exposure of a photograph, by channel", ge=0)
    edge: float = internal(0.03, "edge length of the repaired surface, relative to the body", gt=0, le=0.2)
