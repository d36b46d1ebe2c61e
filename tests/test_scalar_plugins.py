"""The compiled plugins for Mitsuba's scalar renderer: their pictures, alone and in composites, and their albedos."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from adapter_cases import random_anisotropic_adapter, random_interface_adapter
from scalar_cases import CHECKS, MATERIAL, finished, plugins

# Each test compiles the plugins or renders in processes of its own.
pytestmark = [pytest.mark.slow]

TEXTURED = MATERIAL | {
    "albedo": CHECKS,
    "alpha_bottom": {"type": "checkerboard", "color0": 0.1, "color1": 0.4},
}
# Renders a ball or a plate, which fills the picture, under a sky and a bright lamp. Prints the mean colour of each
# rendering of each BSDF, and whether the BSDF is anisotropic.
PICTURES = """
    spp, count, shape, *bsdfs = words
    for seed, bsdf in enumerate(bsdfs):
        look = mi.ScalarTransform4f().look_at([0, -3, 0], [0, 0, 0], [0, 0, 1])
        tilted = mi.ScalarTransform4f().rotate([1, 0, 0], 50).scale(50)
        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sensor": {"type": "perspective", "fov": 24, "to_world": look,
                       "film": {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}},
            "sky": {"type": "constant", "radiance": 0.3},
            "lamp": {"type": "sphere", "center": [2, -3, 3], "radius": 1.0,
                     "emitter": {"type": "area", "radiance": 10.0}},
            "seen": {"type": shape, "bsdf": bsdf} | ({"to_world": tilted} if shape == "rectangle" else {}),
        })
        pictures = [np.array(mi.render(scene, spp=spp, seed=count * seed + k)).mean(axis=(0, 1)) for k in range(count)]
        print(json.dumps(np.array(pictures).tolist()))
        seen, = (shape for shape in scene.shapes() if not shape.is_emitter())
        print(mi.has_flag(seen.bsdf().flags(), mi.BSDFFlags.Anisotropic))
"""


@pytest.fixture(scope="module", autouse=True)
def cache():
    return plugins()


def parsed(lines):
    """Returns an array (renderings, 3) of mean colours for each BSDF."""
    return [np.array(json.loads(line)) for line in lines if line.startswith("[[")]


def pictures(variant, spp, *bsdfs):
    return parsed(finished(PICTURES, variant, spp, 6, "sphere", *bsdfs))


def agree(a, b):
    """Returns whether the means of two sets of six renderings agree within 4.5 standard errors plus 0.1 %.

    A false alarm happens in about one of ten thousand comparisons.
    """
    error = np.sqrt((a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / 6)
    return (np.abs(a.mean(axis=0) - b.mean(axis=0)) < 4.5 * error + 1e-3 * b.mean(axis=0)).all()


def test_scalar_and_vectorised_plugins_render_the_same(tmp_path):
    random_interface_adapter("2x16").save(tmp_path / "interface.safetensors")
    below = {"adapter": str(tmp_path / "interface.safetensors")}
    bsdfs = [{"type": kind, **material} for material in (MATERIAL, TEXTURED) for kind in ("nma", "layered")]
    bsdfs += [{"type": "nma", **below, **material} for material in (MATERIAL, TEXTURED)]
    online = {"type": "nma", "online": True, "precision": "bfloat16", **MATERIAL}
    scalar = pictures("scalar_rgb", 32, *bsdfs, online)
    vectorised = pictures("llvm_ad_rgb", 128, *bsdfs)
    for mine, other in zip(scalar, vectorised, strict=False):
        assert agree(mine, other), (mine.mean(axis=0), other.mean(axis=0))
    assert agree(scalar[-1], vectorised[0])
    # Pictures of two different materials do not agree, so that the comparison can detect errors.
    assert not agree(scalar[0], vectorised[2])


def test_scalar_and_vectorised_plugins_render_anisotropic_adapters_the_same(tmp_path):
    """The scalar plugin and the vectorised plugin render the same picture of an anisotropic adapter.

    The picture of an adapter that ignores the azimuth is different.
    """
    adapter = random_anisotropic_adapter()
    (matrix, bias), *rest = adapter.layers
    blind = dataclasses.replace(adapter, layers=[(matrix * np.float32([1, 0, 0, 0, 0]), bias), *rest])
    bsdfs = []
    for name, made in (("seeing", adapter), ("blind", blind)):
        made.save(tmp_path / f"{name}.safetensors")
        bsdfs.append({"type": "nma", "adapter": str(tmp_path / f"{name}.safetensors")})
    scalar = finished(PICTURES, "scalar_rgb", 32, 6, "sphere", bsdfs[0])
    vectorised = finished(PICTURES, "llvm_ad_rgb", 128, 6, "sphere", *bsdfs)
    assert "True" in scalar and "True" in vectorised
    (mine,), (other, unseeing) = parsed(scalar), parsed(vectorised)
    assert agree(mine, other), (mine.mean(axis=0), other.mean(axis=0))
    assert not agree(mine, unseeing)


def blend(weight, first, second):
    return {"type": "blendbsdf", "weight": weight, "first": first, "second": second}


def mask(opacity, bsdf):
    return {"type": "mask", "opacity": opacity, "inside": bsdf}


def test_composites_are_linear_combinations_of_their_parts():
    """The picture of a composite is the weighted mean of the pictures of its parts, for a plate in front of the sky.

    The test compares 24 means and allows differences of 5 standard errors, which are estimated from 32 renderings. A
    false alarm happens in about one of two thousand runs. A failure means that a part inside a composite is evaluated
    or sampled wrongly.
    """
    layered, nma, diffuse = {"type": "layered", **MATERIAL}, {"type": "nma", **MATERIAL}, {"type": "diffuse"}
    flat = {"type": "normalmap", "normalmap": {"type": "srgb", "color": [0.5, 0.5, 1.0]}}
    # Each composite has four weights. The picture of the composite is the weighted sum of four pictures: of the BSDFs
    # `layered`, `nma` and `diffuse`, and of the sky.
    composites = {
        "blend": (blend(0.3, layered, diffuse), (0.7, 0, 0.3, 0)),
        "mask": (mask(0.6, layered), (0.6, 0, 0, 0.4)),
        "twosided": ({"type": "twosided", "inside": layered}, (1, 0, 0, 0)),
        "two of ours": ({"type": "twosided", "inside": blend(0.5, nma, layered)}, (0.5, 0.5, 0, 0)),
        "nested": (blend(0.5, mask(0.6, layered), blend(0.4, diffuse, layered)), (0.5, 0, 0.3, 0.2)),
        "nma": (mask(0.6, blend(0.5, nma, diffuse)), (0, 0.3, 0.3, 0.4)),
        "alone": (layered, (1, 0, 0, 0)),
        "normalmap": ({**flat, "inside": layered}, (1, 0, 0, 0)),
    }
    bsdfs = [layered, nma, diffuse, *(bsdf for bsdf, _ in composites.values())]
    found = parsed(finished(PICTURES, "scalar_rgb", 8, 32, "rectangle", *bsdfs))
    means = np.array([x.mean(axis=0) for x in found])
    variances = np.array([x.var(axis=0, ddof=1) / len(x) for x in found])
    sky = np.full((1, 3), 0.3)
    parts, noise = np.concatenate([means[:3], sky]), np.concatenate([variances[:3], 0 * sky])
    for (name, (_, shares)), mean, variance in zip(composites.items(), means[3:], variances[3:], strict=True):
        wanted, error = np.dot(shares, parts), np.sqrt(variance + np.dot(np.square(shares), noise))
        assert (np.abs(mean - wanted) < 5 * error).all(), (name, mean / wanted - 1, error / wanted)
        assert (error < 0.01 * wanted).all(), name


def test_diffuse_reflectance_is_the_directional_albedo(tmp_path):
    """The diffuse reflectance of a BSDF equals the mean weight of 20,000 samples at wi, within a tolerance.

    The reflectance has no noise and is at most 1. If the material is seen from behind, the reflectance is 0.
    """
    random_anisotropic_adapter().save(tmp_path / "brushed.safetensors")
    finished(
        """
        rng = np.random.default_rng(0)
        for kind, tolerance, bsdf in zip(("nma", "layered", "nma"), (0.02, 0.1, 0.05), words):
            bsdf = mi.load_dict(bsdf)
            for cosine, azimuth in ((1.0, 0.0), (0.5, 0.0), (0.3, 1.0)):
                si = interaction(cosine, azimuth)
                found = np.array(bsdf.eval_diffuse_reflectance(si))
                drawn = [bsdf.sample(mi.BSDFContext(), si, u[0], u[1:])[1] for u in rng.random((20_000, 3))]
                assert (np.abs(np.mean(drawn, axis=0) - found) < tolerance).all(), (kind, cosine, found)
                assert (found == bsdf.eval_diffuse_reflectance(si)).all() and found.max() <= 1
            assert np.array(bsdf.eval_diffuse_reflectance(interaction(-0.5))).max() == 0
        """,
        "scalar_rgb",
        {"type": "nma", **MATERIAL},
        {"type": "layered", **MATERIAL},
        {"type": "nma", "adapter": str(tmp_path / "brushed.safetensors")},
    )


def test_mitsuba_s_executable_renders_a_scene_with_the_plugin(cache, tmp_path):
    executable = Path(sys.executable).parent / "mitsuba"
    inputs = "".join(
        f'<rgb name="{k}" value="{", ".join(map(str, v["value"]))}"/>'
        if isinstance(v, dict)
        else f'<float name="{k}" value="{v}"/>'
        for k, v in MATERIAL.items()
    )
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f"""<scene version="3.0.0">
            <integrator type="path"/>
            <sensor type="perspective">
                <transform name="to_world"><lookat origin="0,-3,0" target="0,0,0" up="0,0,1"/></transform>
                <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
                <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film>
            </sensor>
            <emitter type="constant"/>
            <shape type="sphere"><bsdf type="nma">{inputs}</bsdf></shape>
        </scene>"""
    )
    command = [executable, "-a", cache, "-m", "scalar_rgb", "-o", tmp_path / "out.exr", scene]
    done = subprocess.run([str(w) for w in command], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (tmp_path / "out.exr").stat().st_size > 1000
