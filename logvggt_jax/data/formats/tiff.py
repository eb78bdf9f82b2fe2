"""TIFF pictures that decoders read wrong."""

from PIL import TiffImagePlugin


def misread(tags: TiffImagePlugin.ImageFileDirectory_v2) -> str | None:
    """What Pillow and OpenCV would decode to other colours without an error; None for the others."""
    if 16 not in tags.get(TiffImagePlugin.BITSPERSAMPLE, ()):
        return None
    if tags.get(TiffImagePlugin.PHOTOMETRIC_INTERPRETATION) == 0:
        return "16 bits whose 0 is white"
    planes = tags.get(TiffImagePlugin.PLANAR_CONFIGURATION) == 2 and tags.get(TiffImagePlugin.SAMPLESPERPIXEL, 1) > 1
    if planes and tags.get(TiffImagePlugin.COMPRESSION, 1) == 1:
        return "16 bits in planes (planar) and without compression"
    return None
