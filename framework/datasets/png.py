"""Encoding of images as PNG files."""

from io import BytesIO

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from framework.geometry.srgb import bytes_from_linear


def encode_png(light: Float[Tensor, "height width number"]) -> bytes:
    """Return the content of an 8-bit PNG file, in sRGB, for an image in linear RGB.

    An image with another number of channels than three becomes a grey image of its first channel.
    """
    numbers = bytes_from_linear(light.cpu()).numpy()
    content = BytesIO()
    Image.fromarray(numbers if numbers.shape[-1] == 3 else numbers[..., 0]).save(content, "PNG")
    return content.getvalue()
