"""Photographs and procedural patterns as linear radiance textures on the 0..255 scale."""

import io
import math
import warnings
from functools import lru_cache
from pathlib import Path

import numpy as np
import PIL.Image
import PIL.ImageOps
import scipy
import torch

from codesign.checks import check_whole
from codesign.doors import explain
from codesign.errors import DomainError, FileFormatError
from codesign.reading import read_bytes, reading
from scenes import rgbe

PHOTOS = (
    "brick",
    "gravel",
    "grass",
    "camera",
    "coffee",
    "chelsea",
    "astronaut",
    "rocket",
    "hubble_deep_field",
)
LIFT = 2.0  # the darkest radiance of a photograph: no real wall is perfectly black
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear red, green and blue: ITU-R BT.709
MOST_PIXELS = 32_000_000
SUN_ELEVATION_DEG = 40.0  # over the horizon
SUN_AZIMUTH_DEG = 200.0  # on the compass: 0 is +y, 90 is +x
ZENITH, HORIZON, BELOW = 90.0, 190.0, 40.0  # radiance of the procedural sky
HDR = (".hdr", ".exr")
FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "GIF", "PPM", "TGA", "WEBP")
MOST_BYTES = 1 << 30
HDR_MEAN = 80.0


def photo(source: str | Path, size_px: int = 512) -> np.ndarray:
    """A photograph as linear luminance.

    Args:
      source: a name out of PHOTOS (CC0 and public-domain pictures that come with scikit-image) or a
        path to an image file.
      size_px: most rows and columns. A file that has more is averaged over areas, in linear light,
        until its longer side has as many: all of it is there, in its own proportions. Of a picture
        out of PHOTOS the first rows and columns are taken, texel by texel.
    Returns: [H, W] float32, from LIFT to 255; of an .hdr or .exr, whose white is not known, scaled
      to a mean of HDR_MEAN, with lights as far above 255 as they are in the file.
    Raises: FileFormatError when there is no such picture.
    """
    if str(source) in PHOTOS:
        return _known(str(source), size_px).copy()
    if Path(source).suffix.lower() in HDR:
        return _scaled(
            reduced(_unscaled(source, "texture"), size_px), 1.0, HDR_MEAN, f"texture {source}"
        )
    return _radiance(reduced(linear(_stored(source)), size_px), str(source))


@lru_cache(maxsize=2 * len(PHOTOS), typed=True)
def _known(name, size_px):
    """A picture out of PHOTOS, which worlds are painted with again and again."""
    import skimage  # whose own reader imports most of scipy

    found = [*Path(skimage.__file__).parent.glob(f"data/{name}.*")]
    stored = _stored(found[0]) if found else getattr(skimage.data, name)()
    return _radiance(linear(stored[:size_px, :size_px]), name)


def file_size(source: str | Path) -> tuple[int, int] | None:
    """Rows and columns of an image file that ``photo`` reads, before it is made smaller; None of
    what is no file."""
    if str(source) in PHOTOS or not Path(source).is_file():
        return None
    if Path(source).suffix.lower() in HDR:
        return _unscaled(source, "texture").shape[:2]
    with PIL.Image.open(source, formats=FORMATS) as image:
        width, height = PIL.ImageOps.exif_transpose(image).size
        return height, width


def _stored(path):
    """Values of an image file as they are stored: [H, W] or [H, W, 3]."""
    if not Path(path).is_file():
        raise FileFormatError(
            f"texture '{path}' is neither a file nor one of {', '.join(PHOTOS)}; give the path of a "
            "PNG, JPEG, HDR or EXR."
        )
    return decoded(read_bytes(path, MOST_BYTES), f"texture {path}")


def decoded(data: bytes, what: str) -> np.ndarray:
    """Values of a picture in the bytes of its file as they are stored, upright as its EXIF says:
    [H, W] or [H, W, 3]; FileFormatError, which begins with ``what``, for damaged, enormous and other ones."""
    with reading(what, "it is no whole picture; convert it to PNG"), warnings.catch_warnings():
        warnings.simplefilter("error", PIL.Image.DecompressionBombWarning)
        try:
            opened = PIL.Image.open(io.BytesIO(data), formats=FORMATS)
        except PIL.UnidentifiedImageError:
            raise ValueError("it begins as none of " + ", ".join(FORMATS)) from None
        with opened as image:
            if image.width * image.height > MOST_PIXELS:
                raise FileFormatError(
                    f"{what} has {image.width} x {image.height} pixels; at most {MOST_PIXELS / 1e6:.0f} million are read, "
                    "make it smaller."
                )
            return stored_values(PIL.ImageOps.exif_transpose(image))


def stored_values(image: PIL.Image.Image) -> np.ndarray:
    """Values of a picture as they are stored: [H, W] or [H, W, 3]. Raises: ValueError where white
    is not known."""
    if image.mode in ("I", "F"):
        raise ValueError("it holds numbers of 32 bits, whose white is not known")
    gray = image.mode == "L" or image.mode.startswith("I;16")
    return np.asarray(image if gray else image.convert("RGB"))


def linear(stored: np.ndarray, shares: np.ndarray = LUMINANCE) -> np.ndarray:
    """Linear luminance 0..1, [H, W] float64, of values coded by the sRGB gamma: [H, W] or
    [H, W, 3], whole numbers or 0..1. shares: of red, green and blue in it, of whole numbers."""
    white = np.iinfo(stored.dtype).max if stored.dtype.kind == "u" else 1.0
    if stored.dtype.kind != "u" or stored.dtype.itemsize > 2:
        return luminance(_light(np.asarray(stored, dtype=np.float64) / white))
    level = _light(np.arange(white + 1) / white)
    if stored.ndim < 3 or stored.shape[2] < 3:
        return luminance(level[stored])
    # colour by colour: a picture of 45 megapixels takes a gigabyte at once
    return sum(share * level[stored[..., colour]] for colour, share in enumerate(shares))


def _light(values):
    """Linear light of values 0..1 coded by the sRGB gamma. Source: IEC 61966-2-1."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def luminance(values: np.ndarray) -> np.ndarray:
    """Luminance [H, W] of values in linear light, [H, W] or [H, W, C] of which the first three are
    red, green, blue."""
    if values.ndim == 3:
        values = values[..., :3] @ LUMINANCE if values.shape[2] >= 3 else values[..., 0]
    return values


def reduced(values: np.ndarray, size_px: int) -> np.ndarray:
    """A picture [H, W] averaged over areas until its longer side has ``size_px`` at most."""
    longest = max(values.shape)
    if longest > size_px:
        for axis, size in enumerate(values.shape):
            values = _averaged(values, max(1, round(size * size_px / longest)), axis)
    return values


def _averaged(values, size, axis):
    """``values`` averaged along ``axis`` over ``size`` equal lengths, of texels that are constant
    inside: the differences of their integral."""
    values = np.moveaxis(values, axis, 0)
    count = len(values)
    integral = np.concatenate([np.zeros_like(values[:1]), np.cumsum(values, 0)])
    at = np.linspace(0, count, size + 1)
    whole = np.minimum(at.astype(int), count - 1)
    part = (at - whole).reshape(-1, *[1] * (values.ndim - 1))
    return np.moveaxis(
        np.diff(integral[whole] + part * values[whole], axis=0) * (size / count), 0, axis
    )


def _radiance(linear, name):
    return check_texture(LIFT + (255 - LIFT) * linear, name)


def shrunk(texture: np.ndarray, factor: int) -> np.ndarray:
    """The texture averaged over factor x factor texels, so that a few samples per pixel see no
    detail between them."""
    factor = check_whole(factor, "texture to shrink: factor", 1, min(texture.shape))
    height, width = (n // factor * factor for n in texture.shape)
    return (
        texture[:height, :width]
        .reshape(height // factor, factor, width // factor, factor)
        .mean((1, 3), dtype=np.float64)
        .astype(np.float32)
    )


def softened(texture: np.ndarray, texels: float, mode: str = "nearest") -> np.ndarray:
    """The texture blurred by a Gaussian of this standard deviation, so that the kinks between
    bilinear texels become small; beside its border it goes on as SciPy's ``mode`` says."""
    return scipy.ndimage.gaussian_filter(
        check_texture(texture, "to soften").astype(np.float64), texels, mode=mode
    ).astype(np.float32)


def _blurred(values, texels, axis, mode):
    """``values`` blurred by a Gaussian along ``axis``, beyond the border as NumPy's ``mode`` says; to
    the last bit what scipy.ndimage.gaussian_filter1d gives, whose import takes ten times as long."""
    reach = int(4 * texels + 0.5)
    share = np.exp(-0.5 / texels**2 * np.arange(-reach, 1) ** 2)
    share /= np.concatenate([share, share[-2::-1]]).sum()
    around = [(reach, reach) if each == axis else (0, 0) for each in range(values.ndim)]
    wide = np.pad(values, around, mode=mode)  # pyright: ignore[reportCallIssue, reportArgumentType]
    wide = np.ascontiguousarray(np.moveaxis(wide, axis, 0))
    size = values.shape[axis]
    found = wide[reach : reach + size] * share[reach]
    for k in range(reach):
        found += (wide[k : k + size] + wide[2 * reach - k :][:size]) * share[k]
    return np.ascontiguousarray(np.moveaxis(found, 0, axis))


def speckle(
    seed: int,
    size_px: int = 512,
    finest_px: float = 6.0,
    coarsest_px: float = 64.0,
    contrast: float = 0.5,
) -> np.ndarray:
    """Random pattern with equal power per octave between two periods (texels), exp of a Gaussian
    field:
    [size, size] float32."""
    octaves = _octaves(size_px, finest_px, coarsest_px)
    noise = np.fft.fft2(np.random.default_rng(seed).standard_normal((size_px, size_px)))
    field = np.fft.ifft2(noise * octaves).real
    return check_texture(60.0 * np.exp(contrast * field / field.std()), f"speckle {seed}")


@lru_cache(maxsize=1)
def _octaves(size_px, finest_px, coarsest_px):
    """Amplitude [size, size] of equal power per octave between two periods (texels)."""
    frequency = np.fft.fftfreq(size_px)
    radius = np.hypot(frequency[:, None], frequency)
    return ((radius >= 1 / coarsest_px) & (radius <= 1 / finest_px)) / np.maximum(radius, 1e-6)


def checkerboard(
    squares: int = 8, square_px: int = 32, dark: float = 10.0, bright: float = 200.0
) -> np.ndarray:
    """Black and white squares, [H, W] float32."""
    row = np.arange(squares * square_px) // square_px
    return np.where((row[:, None] + row) % 2 == 0, bright, dark).astype(np.float32)


def faded_to(texture: np.ndarray, level: float, margin: float = 0.12) -> np.ndarray:
    """The texture with its borders fading smoothly to a constant, so that adjoining walls meet
    without a jump."""
    texture = check_texture(texture, "to fade")
    ramps = []
    for size in texture.shape:
        at = (np.arange(size) + 0.5) / size
        # the outermost quarter of the margin is constant
        u = np.clip(np.minimum(at, 1 - at) / margin - 0.25, 0, 1)
        ramps.append(u * u * (3 - 2 * u))
    return (level + (texture - level) * ramps[0][:, None] * ramps[1]).astype(np.float32)


def check_texture(values, name):
    """Radiances [H, W] as float32. Raises: DomainError unless all are finite and at least 0, and
    for whole numbers of any width, which may be light or be coded by the sRGB gamma (``picture`` is
    told which)."""
    values = np.asarray(values)
    if values.dtype.kind in "ui":
        raise DomainError(
            f"texture {name}: an array of {values.dtype} may hold pixels coded as in a PNG, or radiance; say which: "
            "textures.picture(array, encoding='srgb') or encoding='linear'."
        )
    if values.dtype.kind not in "bf":
        raise DomainError(
            f"texture {name}: it holds no numbers; give radiances of at least 0, [H, W]."
        )
    with np.errstate(over="ignore"):
        values = values.astype(np.float32)
    wrong = None
    if values.ndim != 2 or not values.size:
        wrong = f"shape {values.shape} instead of [H, W] with"
    elif not np.isfinite(values).all():
        wrong = "NaN or infinite"
    elif (values < 0).any():
        wrong = "negative"
    if wrong:
        raise DomainError(
            f"texture {name}: {wrong} values; give finite radiances of at least 0 as a 2-D array."
        )
    return values


def picture(
    source: str | Path | np.ndarray, blur_texels: float = 2.0, encoding: str | None = None
) -> np.ndarray:
    """What a world's surface is given: an array [H, W], a path, one of PHOTOS, or "speckle-3"
    (seed 3); files and photographs softened by ``blur_texels``.

    Args:
      encoding: of an array: None or "linear" takes it as radiance 0..255, "srgb" as pixels [H, W]
        or [H, W, 3], coded as those of a PNG: uint8, uint16 or 0..1. Whole numbers of any width are
        refused without it, and as "srgb" of another width, whose white is not known.
    """
    if encoding not in (None, "linear", "srgb"):
        raise DomainError(f"encoding = {encoding!r} is not known; give 'linear' or 'srgb'.")
    if isinstance(source, str | Path):
        if encoding is not None:
            raise DomainError(f"encoding is of arrays, and '{source}' says its own; leave it out.")
    elif encoding == "srgb":
        pixels = np.asarray(source)
        known = pixels.dtype.kind == "f" or pixels.dtype in (np.uint8, np.uint16)
        if not known or pixels.ndim not in (2, 3) or not pixels.size:
            raise DomainError(
                f"an array coded by sRGB has pixels [H, W] or [H, W, 3], uint8, uint16 or 0..1, not {pixels.dtype} "
                f"{pixels.shape}; numbers of 0 to 255 become so by .astype(np.uint8)."
            )
        if pixels.dtype.kind == "f" and (pixels.max() > 1 + 1e-6 or pixels.min() < 0):
            odd = pixels.min() if pixels.min() < 0 else pixels.max()
            raise DomainError(
                f"an array coded by sRGB has a {odd:g}, and floating-point pixels go from 0 to 1; divide by "
                "white."
            )
        return _radiance(linear(pixels).clip(max=1), "given as an array")
    else:
        values = np.asarray(source)
        return check_texture(
            values.astype(float) if encoding and values.dtype.kind in "ui" else values,
            "given as an array",
        )
    if str(source).startswith("speckle-") and str(source)[8:].isdigit():
        return np.minimum(
            softened(speckle(int(str(source)[8:]), finest_px=16.0, contrast=0.4), blur_texels), 255
        )
    return softened(photo(source), blur_texels)


def sky(
    seed: int = 0,
    height_px: int = 256,
    sun_azimuth_deg: float = SUN_AZIMUTH_DEG,
) -> np.ndarray:
    """A procedural sky as an equirectangular picture [height, 2 height], first row at the zenith: a
    gradient, soft clouds, a broad soft sun; 255 at most."""
    width = 2 * height_px
    elevation = np.pi / 2 - (np.arange(height_px)[:, None] + 0.5) * np.pi / height_px
    azimuth = (np.arange(width) + 0.5) * 2 * np.pi / width
    noise = np.random.default_rng(seed).standard_normal((height_px, width))
    noise = _blurred(_blurred(noise, height_px / 48, 0, "edge"), height_px / 20, 1, "wrap")
    clouds = 25 * np.tanh(1.5 * noise / noise.std()) * np.clip(2 * elevation, 0, 1)
    up = np.clip(elevation / (np.pi / 2), 0, 1)
    clear = HORIZON + (ZENITH - HORIZON) * up**0.6 + clouds
    e = np.radians(SUN_ELEVATION_DEG)
    a = np.radians(sun_azimuth_deg)
    cosine = np.sin(elevation) * np.sin(e) + np.cos(elevation) * np.cos(e) * np.cos(azimuth - a)
    bright = clear + (250 - clear) * np.exp(20 * (cosine - 1))
    below = 1 / (1 + np.exp(elevation / 0.02))  # no jump at the horizon
    return check_texture(
        np.clip(bright + (BELOW - bright) * below, 0, 255), "of the procedural sky"
    )


def environment(path: str | Path, mean: float = 80.0) -> np.ndarray:
    """Luminance of an equirectangular HDR file (.hdr, .exr, or any picture Mitsuba reads), scaled
    to a mean radiance over the sphere: [H, W] float32.

    Bright lamps and suns stay as far above 255 as they are in the file. Raises: FileFormatError
    when it is missing or unreadable, DomainError for bad values.
    """
    values = _unscaled(path, "environment map")
    weight = np.sin((np.arange(len(values)) + 0.5) * np.pi / len(values))[:, None]
    return _scaled(values, weight / weight.mean(), mean, f"environment map {path}")


def _unscaled(path, what):
    """Luminance [H, W] float64 of a picture in linear light, in the units of its file."""
    if not Path(path).is_file():
        raise FileFormatError(
            f"{what} '{path}' is not a file; give the path of an .hdr or .exr picture."
        )
    if Path(path).suffix.lower() not in HDR:
        return linear(_stored(path))
    return check_texture(luminance(rgbe.read(path)), str(path)).astype(np.float64)


def _scaled(values, weight, mean, name):
    if not 0 < mean < math.inf:
        raise DomainError(f"{name}: mean = {mean} must be positive and finite.")
    level = (values * weight).mean()
    if level <= 0:
        raise DomainError(f"{name} is black; give one with light in it.")
    return check_texture(values * (mean / level), name)


def waves(
    seed: int,
    count: int = 24,
    finest_period_m: float = 0.05,
    coarsest_period_m: float = 0.5,
    log_contrast: float = 0.4,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Random plane waves for TexturedPlane: frequency [K, 2] (per metre), amplitude [K], phase [K];
    periods spread evenly in octaves."""
    generator = torch.Generator().manual_seed(seed)
    u = torch.rand(3, count, generator=generator, dtype=torch.float64)
    period = finest_period_m * (coarsest_period_m / finest_period_m) ** u[0]
    angle = 2 * math.pi * u[1]
    frequency = torch.stack([angle.cos(), angle.sin()], 1) / period[:, None]
    return (
        frequency,
        torch.full((count,), log_contrast * (2 / count) ** 0.5, dtype=torch.float64),
        2 * math.pi * u[2],
    )


explain(globals())
