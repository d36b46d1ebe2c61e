"""Makes Mitsuba textures from arrays, and makes procedural arrays: worn metal, patches of lacquer, marbled pigment.

The values are linear parameters of a material, not colours on a screen, so `bitmap_texture` loads them as raw data. The
procedural textures tile without seams. The seed determines all values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.errors import TextureError

Array = NDArray[np.float64]
LACQUER = np.array([[0.93, 0.60, 0.14], [0.80, 0.10, 0.06], [0.10, 0.38, 0.42], [0.97, 0.93, 0.84]])


def procedural_textures(size: int = 512, seed: int = 0) -> dict[str, NDArray[np.float32]]:
    """Three textures for the class `layered3`: the independent patterns of one worn, lacquered object.

    Args:
        size: width and height in texels, at least 16.
        seed: another seed gives another object; equal seeds give equal values.

    Returns:
        The arrays by parameter name. `alpha_bottom` (size, size), in 1e-3..1, is the roughness of a polished metal with
        fingerprints and scratches. `sigma_t` (size, size), in 0..1, has patches with soft edges where the pigmented
        medium is worn off. `albedo` (size, size, 3), in 0..1, is the colour of marbled pigments.

    Raises:
        TextureError: the size is below 16.
    """
    if size < 16:
        raise TextureError(f"procedural_textures: size {size} is too small; choose 16 or more")
    rng = np.random.default_rng(seed)
    textures = {
        "alpha_bottom": _worn_metal(rng, size),
        "sigma_t": _patches(rng, size),
        "albedo": _marble(rng, size),
    }
    return {name: texture.astype(np.float32) for name, texture in textures.items()}


def periodic_noise(rng: np.random.Generator, size: int, *, period: float, slope: float = 2.0) -> Array:
    """Smooth periodic noise: (size, size), mean 0, standard deviation 1.

    White noise is filtered in the frequency domain: the amplitude is constant up to the frequency 1/period, and then
    falls with frequency^-slope. The noise continues without a seam across the border of the texture, because each
    frequency is a whole number of cycles per texture. Equal seeds give the same pattern at every size.

    Args:
        period: size of the largest features, as a fraction of the texture's width.
        slope: 1.5 gives rough noise, 3 gives smooth noise.
    """
    frequency = np.fft.fftfreq(size, 1.0 / size)
    radius = np.hypot(*np.meshgrid(frequency, frequency))
    amplitude = np.where(radius > 0.0, np.maximum(radius * period, 1.0) ** -slope, 0.0)
    spectrum = _low_frequencies(rng, size) * amplitude
    noise = np.fft.ifft2(spectrum).real
    return noise / noise.std()


def _low_frequencies(rng: np.random.Generator, size: int, cutoff: int = 64) -> NDArray[np.complex128]:
    """A spectrum (size, size) of white noise up to `cutoff` cycles per tile. The value at each frequency does not
    depend on `size`."""
    block = rng.normal(size=(2, 2 * cutoff + 1, 2 * cutoff + 1))
    reach = min(cutoff, size // 2 - 1)
    inner = block[:, cutoff - reach : cutoff + reach + 1, cutoff - reach : cutoff + reach + 1]
    spectrum = np.zeros((size, size), dtype=np.complex128)
    index = np.arange(-reach, reach + 1) % size
    spectrum[np.ix_(index, index)] = inner[0] + 1j * inner[1]
    return spectrum


def _smoothstep(low: float, high: float, x: Array) -> Array:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _worn_metal(rng: np.random.Generator, size: int) -> Array:
    """Microfacet widths alpha (size, size): polished metal with fingerprints, scratches and dull clouds. The function
    combines the logarithms of alpha of the patterns."""
    clouds = periodic_noise(rng, size, period=0.35, slope=2.2)
    log_alpha = -1.35 + 0.28 * clouds
    log_alpha += 0.55 * _finger_prints(rng, size)
    log_alpha = np.maximum(log_alpha, -1.6 + 1.25 * _scratches(rng, size, count=90))
    return np.clip(10.0**log_alpha, 1e-3, 1.0)


def _finger_prints(rng: np.random.Generator, size: int, count: int = 5) -> Array:
    """The ridges of fingerprints (size, size) in 0..1: soft ovals at random places, filled with concentric ovals that
    noise bends."""
    x, y = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size)
    bend = periodic_noise(rng, size, period=0.25, slope=3.0)
    prints = np.zeros((size, size))
    for _ in range(count):
        cx, cy, turn, scale = *rng.uniform(size=2), rng.uniform(0.0, np.pi), rng.uniform(0.085, 0.12)

        # Distances are measured to the nearest copy of the centre, so that a fingerprint continues across the border of
        # the tile.
        dx, dy = (x - cx + 0.5) % 1.0 - 0.5, (y - cy + 0.5) % 1.0 - 0.5
        along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
        oval = np.hypot(along / 1.45, across) / scale
        ridges = 0.5 + 0.5 * np.sin(2.0 * np.pi * (7.0 * oval + 0.55 * bend))
        prints = np.maximum(prints, ridges * _smoothstep(1.0, 0.7, oval))
    return prints


def _scratches(rng: np.random.Generator, size: int, count: int) -> Array:
    """Thin straight lines (size, size) in 0..1 with tapering ends, which continue across the border of the tile."""
    texel = 1.0 / size
    x, y = np.meshgrid((np.arange(size) + 0.5) * texel, (np.arange(size) + 0.5) * texel)
    scratches = np.zeros((size, size))
    for _ in range(count):
        cx, cy, depth = *rng.uniform(size=2), rng.uniform(0.35, 1.0)
        turn, half = rng.normal(0.6, 0.5), rng.uniform(0.04, 0.24)
        width = max(rng.uniform(0.0008, 0.0022), 0.6 * texel)
        dx, dy = (x - cx + 0.5) % 1.0 - 0.5, (y - cy + 0.5) % 1.0 - 0.5
        along, across = dx * np.cos(turn) + dy * np.sin(turn), dy * np.cos(turn) - dx * np.sin(turn)
        line = np.clip(1.5 - np.abs(across) / width, 0.0, 1.0) * _smoothstep(1.0, 0.6, np.abs(along) / half)
        scratches = np.maximum(scratches, depth * line)
    return scratches


def _patches(rng: np.random.Generator, size: int) -> Array:
    """Extinction (size, size): lacquer of uneven thickness, with islands where the lacquer is worn off."""
    wear = periodic_noise(rng, size, period=0.30, slope=2.4)
    thickness = 0.85 + 0.10 * periodic_noise(rng, size, period=0.5, slope=3.0)
    return np.clip(thickness * _smoothstep(-0.75, -0.35, wear), 0.0, 1.0)


def _marble(rng: np.random.Generator, size: int) -> Array:
    """Colours (size, size, 3) in bands along a warped coordinate. The bands repeat after one tile."""
    x, y = np.meshgrid((np.arange(size) + 0.5) / size, (np.arange(size) + 0.5) / size)
    warp = 0.16 * periodic_noise(rng, size, period=0.45, slope=3.0) + 0.03 * periodic_noise(
        rng, size, period=0.15
    )
    phase = len(LACQUER) * (x + 2.0 * y + warp)
    band = np.floor(phase).astype(int) % len(LACQUER)
    edge = _smoothstep(0.78, 0.94, phase - np.floor(phase))[..., None]
    colour = (1.0 - edge) * LACQUER[band] + edge * LACQUER[(band + 1) % len(LACQUER)]
    grain = 1.0 + 0.05 * periodic_noise(rng, size, period=0.05, slope=1.5)[..., None]
    return np.clip(colour * grain, 0.0, 1.0)


def bitmap_texture(values: NDArray[np.floating], *, scale: float = 1.0) -> dict[str, Any]:
    """Mitsuba's dictionary of a `bitmap` texture with the values of an array, without any colour conversion.

    Args:
        values: (height, width) or (height, width, 3), linear.
        scale: how often the texture repeats per unit of uv.
    """
    import mitsuba as mi

    texture: dict[str, Any] = {
        "type": "bitmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(values, dtype=np.float32)),
    }
    texture |= {"raw": True, "filter_type": "bilinear", "wrap_mode": "repeat"}
    return texture | {"to_uv": mi.ScalarTransform4f().scale([scale, scale, 1.0])}
