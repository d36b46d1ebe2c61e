"""Our BSDFs inside Mitsuba's composite BSDFs: the picture of a composite is the weighted sum of its parts' pictures.

Each integrator renders one sheet of small cells under a sky. Each cell shows one BSDF, alone or in a composite.
"""

import gc

import mitsuba as mi
import numpy as np
import pytest
from adapter_cases import random_adapter, random_anisotropic_adapter
from scipy.stats import norm

import nma.render
from nma.jit import dr
from nma.render.textures import bitmap_texture
from nma.render.values_bsdf import bsdf_of
from nma.sources.coating import Coating

COLUMNS = 8
PIXELS = 10  # pixels along the side of a cell, with its border
SEEDS, SPP = 4, 48
FALSE_ALARM = 0.001  # the false-alarm rate of all cells of a sheet together
WEIGHT, OPACITY = 0.4, 0.7
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.8, 0.5, 0.2]}}

INTEGRATORS = {
    "path": {"type": "path", "max_depth": 3},
    "direct": {"type": "direct"},
    "direct, lights": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
    "direct, bsdf": {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1},
    "volpath": {"type": "volpath", "max_depth": 3},
    "prb": {"type": "prb", "max_depth": 3},
    "aov": {"type": "aov", "aovs": "albedo:albedo", "picture": {"type": "direct"}},
}


@pytest.fixture(autouse=True)
def _variant():
    nma.render.use("llvm_ad_rgb")
    gc.collect()  # deletes old scenes, because Dr.Jit would record their BSDFs too


@pytest.fixture(scope="module")
def bsdfs(tmp_path_factory):
    """Descriptions of our BSDFs, one of each kind."""
    nma.render.use("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("weights")
    random_adapter(hidden="1x4").save(folder / "small.safetensors")
    random_anisotropic_adapter(hidden="1x4").save(folder / "brushed.safetensors")
    layers = {"material": "frosted-silver", "alpha_bottom": 0.3}
    adapter = {"type": "nma", "adapter": str(folder / "small.safetensors"), "clamp": True} | layers
    grey = {"sigma_t": bitmap_texture(np.full((2, 2, 1), 0.8))}
    return {
        "nma": adapter,
        "nma, textured": adapter | grey,
        "nma, anisotropic": {"type": "nma", "adapter": str(folder / "brushed.safetensors")},
        "layered": {"type": "layered"} | layers | grey,
        "values": bsdf_of(Coating(alpha=0.2)),
    }


def blend(bsdf):
    return {"type": "blendbsdf", "weight": WEIGHT, "a": bsdf, "b": DIFFUSE}


def mask(bsdf):
    return {"type": "mask", "opacity": OPACITY, "a": bsdf}


def twosided(bsdf):
    return {"type": "twosided", "a": bsdf}


def normalmap(bsdf):
    up = np.broadcast_to(np.array([0.5, 0.5, 1.0]), (2, 2, 3))
    return {"type": "normalmap", "normalmap": bitmap_texture(up), "a": bsdf}


# The composites, each with a function that makes the composite from a BSDF, and with three weights. The picture of the
# composite is a sum of three pictures with the three weights: of the BSDF, of the diffuse BSDF, and of the sky.
COMPOSITES = {
    "blendbsdf": (blend, (1 - WEIGHT, WEIGHT, 0.0)),
    "mask": (mask, (OPACITY, 0.0, 1 - OPACITY)),
    "twosided": (twosided, (1.0, 0.0, 0.0)),
    "normalmap": (normalmap, (1.0, 0.0, 0.0)),
    "blend of itself": (lambda b: {"type": "blendbsdf", "weight": WEIGHT, "a": b, "b": b}, (1.0, 0.0, 0.0)),
    "nested": (
        lambda b: mask(twosided(blend(normalmap(b)))),
        (OPACITY * (1 - WEIGHT), OPACITY * WEIGHT, 1 - OPACITY),
    ),
}
# Every BSDF is tested in the composites COMMON. To save compile time, only the two BSDFs IN_ALL are tested in all
# composites. The textured `nma` is one of the two because it keeps results between calls, and `layered` because it
# simulates random walks.
COMMON = ("blendbsdf", "nested")
IN_ALL = ("nma, textured", "layered")


def pairs(bsdfs):
    """Lists the pairs of a BSDF and a composite that have a cell on the sheet."""
    return [(b, c) for b in bsdfs for c in COMPOSITES if c in COMMON or b in IN_ALL]


def cells(bsdfs):
    """Returns the BSDFs of all cells by name: the diffuse BSDF, a transparent BSDF, our BSDFs, and the composites."""
    sheet = {"diffuse": DIFFUSE, "none": {"type": "mask", "opacity": 0.0, "a": DIFFUSE}} | bsdfs
    return sheet | {f"{b} in {c}": COMPOSITES[c][0](bsdfs[b]) for b, c in pairs(bsdfs)}


def sheet_scene(sheet, integrator):
    """Loads a scene of flat cells, all seen at 45 degrees, under a sky with a bright patch.

    All pixels have the same view direction and the same light, so that all pixels of a cell have the same distribution.
    """
    rows = -(-len(sheet) // COLUMNS)
    sky = np.full((8, 16, 3), 0.3, np.float32)
    sky[1:3, 4:7] = [1.2, 0.9, 0.6]
    middle = [COLUMNS / 2, rows / 2, 0.0]
    transform = mi.ScalarTransform4f
    description = {
        "type": "scene",
        "integrator": integrator,
        "sky": {
            "type": "envmap",
            "bitmap": mi.Bitmap(sky),
            "to_world": transform().rotate([1, 0, 0], 90),
        },
        "sensor": {
            "type": "orthographic",
            "to_world": transform()
            .look_at([middle[0], middle[1] - 20, 20], middle, [0, 0, 1])
            .scale([COLUMNS / 2, COLUMNS / 2, 1]),
            "film": {
                "type": "hdrfilm",
                "width": COLUMNS * PIXELS,
                "height": rows * PIXELS,
                "rfilter": {"type": "box"},
                "pixel_format": "rgb",
                "component_format": "float32",
            },
        },
    }
    for number, bsdf in enumerate(sheet.values()):
        place = [number % COLUMNS + 0.5, number // COLUMNS + 0.5, 0.0]
        description[f"cell{number}"] = {
            "type": "rectangle",
            "to_world": transform().translate(place).scale(0.45),
            "bsdf": bsdf,
        }
    return mi.load_dict(description)


def inner_pixels(scene, count):
    """Returns one mask (height, width) per cell, which marks the pixels that lie completely inside the cell."""
    width, height = scene.sensors()[0].film().size()
    shapes = {shape.id(): shape for shape in scene.shapes()}
    corners = []
    for dx, dy in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)):
        x, y = dr.meshgrid(dr.arange(mi.Float, width), dr.arange(mi.Float, height))
        film = mi.Point2f((x + dx) / width, (y + dy) / height)
        ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
        corners.append(scene.ray_intersect(ray).shape)
    masks = []
    for number in range(count):
        own = mi.ShapePtr(shapes[f"cell{number}"])
        masks.append(np.all([np.array(c == own).reshape(height, width) for c in corners], axis=0))
    return masks


def measured(scene, names):
    """Returns the mean (channels,) of every cell over its pixels and several seeds, and the variance of this mean."""
    pictures = np.stack([np.array(mi.render(scene, spp=SPP, seed=seed), np.float64) for seed in range(SEEDS)])
    found = {}
    for name, inside in zip(names, inner_pixels(scene, len(names)), strict=True):
        values = pictures[:, inside].reshape(-1, pictures.shape[-1])
        assert len(values) > 60
        found[name] = values.mean(0), values.var(0, ddof=1) / len(values)
    return found


def scores(found, bsdfs):
    """Returns by how many standard deviations each composite differs from the weighted sum of its parts.

    The result is a dictionary from the names of cells to arrays (channels,).
    """
    result = {}
    for name, composite in pairs(bsdfs):
        weights = COMPOSITES[composite][1]
        mean, variance = found[f"{name} in {composite}"]
        terms = [found[part] for part in (name, "diffuse", "none")]
        expected = sum(w * m for w, (m, _) in zip(weights, terms, strict=True))
        spread = variance + sum(w * w * v for w, (_, v) in zip(weights, terms, strict=True))
        z = (mean - expected) / np.sqrt(spread + (1e-4 * expected) ** 2 + 1e-14)
        # The channels after the first three are albedos. Albedos are not compared for composites with Mitsuba's
        # `mask`, because `mask` does not multiply albedos by its opacity.
        result[f"{name} in {composite}"] = z[:3] if "mask" in composite or composite == "nested" else z
    return result


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_composites_are_linear_combinations(bsdfs, integrator):
    sheet = cells(bsdfs)
    scene = sheet_scene(sheet, INTEGRATORS[integrator])
    found = measured(scene, sheet)
    differences = scores(found, bsdfs)
    limit = norm.isf(0.5 * FALSE_ALARM / sum(map(len, differences.values())))
    off = {name: z.round(1) for name, z in differences.items() if np.abs(z).max() > limit}
    assert not off, (limit, off)
    if integrator == "direct, lights":
        return  # with light sampling alone, pictures of narrow lobes are too noisy for the next check
    # A bias of 3 % would be detected: in the median over single BSDFs and colour channels, 3 % of the mean is more than
    # `limit` standard errors.
    seen = [(0.03 * m / np.sqrt(v + 1e-14))[:3] for m, v in (found[name] for name in bsdfs)]
    assert np.median(seen) > limit


@pytest.mark.parametrize("name", ("nma, textured", "nma, anisotropic", "layered"))
def test_composites_render_in_the_integrator_direct(bsdfs, name):
    """The integrator `direct` renders pictures of composites that are finite and not black.

    Unlike a path tracer, `direct` evaluates and samples a BSDF in separate calls.

    The slow test `test_composites_are_linear_combinations` also compares the values of the pictures.
    """
    sheet = {"mask": mask(bsdfs[name]), "blend": blend(bsdfs[name])}
    picture = np.array(mi.render(sheet_scene(sheet, INTEGRATORS["direct"]), spp=4))
    assert np.isfinite(picture).all()
    assert picture.mean() > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_composites_can_be_frozen(bsdfs, integrator):
    """`dr.freeze` records the rendering of the sheet once, and the frozen function returns the same picture."""
    bsdfs = {name: bsdfs[name] for name in ("nma, textured", "layered", "values")}
    loaded = sheet_scene(cells(bsdfs), INTEGRATORS[integrator])
    film = {"type": "hdrfilm", "width": 32, "height": 32}
    look = mi.ScalarTransform4f().look_at([4, -18, 20], [4, 2, 0], [0, 0, 1])
    # Mitsuba's orthographic sensor cannot be frozen, so this test uses a perspective sensor.
    sensor = mi.load_dict({"type": "perspective", "fov": 20, "to_world": look, "film": film})
    frozen = dr.freeze(lambda loaded, sensor: mi.render(loaded, sensor=sensor, spp=8))
    expected = np.array(mi.render(loaded, sensor=sensor, spp=8))
    for _ in range(2):
        np.testing.assert_allclose(np.array(frozen(loaded, sensor)), expected, rtol=1e-4, atol=1e-5)
    assert frozen.n_recordings == 1
