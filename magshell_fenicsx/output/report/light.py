"""Large pictures made smaller for a report; the files beside it keep every pixel."""

import io

LARGE = 250_000  # bytes
WIDEST, COLOURS = 1100, 256  # pixels: the width of the page


def light(content: bytes) -> bytes:
    """A PNG file as it is, or if it is large with the page's width and a palette; other files as they are."""
    if len(content) < LARGE or not content.startswith(b"\x89PNG"):
        return content
    from PIL import Image

    with Image.open(io.BytesIO(content)) as image:
        size = min(WIDEST, image.width), round(image.height * min(WIDEST / image.width, 1))
        smaller = image.convert("RGB").resize(size, Image.Resampling.BOX, reducing_gap=2.0)
    reduced = io.BytesIO()
    smaller.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(
        reduced, "PNG", compress_level=6
    )
    return min(content, reduced.getvalue(), key=len)
