"""The lightings of the preview scene: their lights, the noise of their pictures, and clamping of fireflies."""

import numpy as np
import pytest

import nma.render
from nma.cli.preview import View
from nma.errors import ParamError
from nma.materials import load as load_material
from nma.render.fireflies import clamped
from nma.render.lighting import LIGHTINGS, SOFTBOXES, sky_directions, sky_radiance, studio_radiance
from nma.render.load import load_dict
from nma.render.progressive import pass_sizes, render_passes, sampler
from nma.render.scene import PAPER_TONE, _graph_paper, preview_scene

nma.render.use("llvm_ad_rgb")
import mitsuba as mi  # noqa: E402

GREY = {"type": "diffuse"}
POLISHED = {"type": "roughconductor", "alpha": 0.02}


def at(image, direction):
    """Returns the pixel of a latitude-longitude image that lies closest to a direction."""
    unit = np.array(direction) / np.linalg.norm(direction)
    return image.reshape(-1, 3)[np.argmax(sky_directions(len(image)).reshape(-1, 3) @ unit)]


def render(lighting, spp, size=48, seed=0, bsdf=POLISHED, **options):
    return render_passes(
        load_dict(preview_scene(bsdf, size=(size, size), lighting=lighting, **options)), spp, seed=seed
    )


def test_softboxes_hang_at_their_stated_directions():
    image = studio_radiance()
    for box in SOFTBOXES:
        added = at(image, box.towards) - at(image, -np.array(box.towards) * [1, 1, -1])
        assert added == pytest.approx(box.radiance, abs=0.3)


def test_the_studio_has_no_small_bright_light_and_a_dark_horizon():
    image = studio_radiance().mean(axis=2)
    assert image.max() < 30.0 < 500.0 < sky_radiance().max()
    up = sky_directions(len(image))[..., 2]
    assert np.median(image[(up > 0.0) & (up < 0.05)]) < 0.05 < 0.2 < image[up > 0.9].min()


@pytest.mark.slow
def test_the_studio_leaves_weaker_fireflies_than_outdoors():
    """Fireflies of a polished ball are five times weaker in the studio than outdoors, at 16 samples per pixel.

    The firefly in a pixel is the part of its value that exceeds five times its converged value.
    """
    beyond = {}
    for lighting in LIGHTINGS:
        converged = render(lighting, 256, size=32, seed=1).mean(axis=2)
        noisy = np.stack([render(lighting, 16, size=32, seed=seed).mean(axis=2) for seed in range(2, 8)])
        beyond[lighting] = np.maximum(noisy - 5.0 * converged, 0.0).sum()
    assert beyond["studio"] < 0.2 * beyond["outdoors"]


def test_outdoors_is_the_lighting_of_the_committed_results():
    """The mean colour of a picture is the same as when the results in `bench/` and `figures/` were committed.

    A failure means that the lighting has changed, so that new results cannot be compared with the committed results.
    """
    image = render("outdoors", 256, size=32, seed=3, bsdf=GREY)
    assert image.mean(axis=(0, 1)) == pytest.approx([0.2899, 0.2851, 0.2839], rel=0.01)


@pytest.mark.parametrize("lighting", LIGHTINGS)
def test_the_floor_reflects_less_than_it_receives(lighting):
    reflectance = _graph_paper(512, *PAPER_TONE[lighting])
    assert 0.0 < reflectance.min() < reflectance.max() < 0.6


def test_unknown_lightings_and_a_missing_sun_are_refused():
    with pytest.raises(ParamError, match="unknown lighting 'indoors'; choose studio or outdoors"):
        preview_scene(GREY, lighting="indoors")
    with pytest.raises(ParamError, match="no sun to hide"):
        preview_scene(GREY, hide_sun=True)


@pytest.mark.parametrize(("spp", "pixels"), [(128, 512 * 512), (64, 256 * 256), (100, 192 * 192), (7, 64)])
def test_multijittered_samples_fill_a_grid(spp, pixels, capfd):
    """`sampler` chooses the sampler `multijitter` only for sample counts that Mitsuba does not change.

    Mitsuba rounds a count up if the samples do not fill a grid, and prints a warning. A failure means that a picture
    has more samples than the user asked for.
    """
    kind = sampler(spp, pixels)
    for samples in pass_sizes(spp, pixels):
        taken = mi.load_dict({"type": kind, "sample_count": samples}).sample_count()
        assert taken == samples
    assert capfd.readouterr().out == ""


def test_the_command_asks_for_no_sample_count_that_mitsuba_warns_of(capfd):
    """A picture of 128 samples per pixel is rendered in two passes of 64 samples, which fill a grid.

    Mitsuba would print a warning for a pass of 128 samples, because 128 samples do not fill a grid.
    """
    view = View((192, 192), 128, 6, "hero", "studio", None, "llvm_ad_rgb")
    assert sampler(128, 192 * 192) == "multijitter"
    view.load(load_material("wet-nickel"), "layered")
    assert "WARN" not in "".join(capfd.readouterr())


def test_nearly_all_sample_counts_can_be_multijittered():
    kinds = [sampler(spp, 512 * 512) for spp in range(1, 513)]
    assert kinds.count("multijitter") > 490


@pytest.mark.slow
def test_multijittered_samples_leave_less_noise():
    converged = render("studio", 1024, size=32, seed=1, bsdf=GREY)
    error = {
        kind: np.square(render("studio", 64, size=32, seed=2, bsdf=GREY, sampler=kind) - converged).mean()
        for kind in ("independent", "multijitter")
    }
    assert error["multijitter"] < 0.75 * error["independent"]


@pytest.mark.parametrize("variant", ["llvm_ad_rgb", "scalar_rgb"])
def test_a_clamped_sample_keeps_its_colour(variant):
    mi.set_variant(variant)
    try:
        for limit, sky, expected in (
            (2, [8, 4, 2], [2, 1, 0.5]),
            (9, [8, 4, 2], [8, 4, 2]),
            (1, [0, 0, 0], [0, 0, 0]),
        ):
            light = {"type": "constant", "radiance": {"type": "rgb", "value": sky}}
            film = {"type": "hdrfilm", "width": 4, "height": 4}
            scene = mi.load_dict(
                {"type": "scene", "sky": light, "eye": {"type": "perspective", "film": film}}
            )
            integrator = clamped(mi.load_dict({"type": "path"}), limit)
            image = np.array(mi.render(scene, integrator=integrator, spp=4))
            assert image[1, 2, :3] == pytest.approx(expected, rel=1e-5)
    finally:
        mi.set_variant("llvm_ad_rgb")


def test_clamping_only_darkens_and_removes_fireflies():
    scene = load_dict(preview_scene(POLISHED, size=(32, 32), lighting="outdoors"))
    plain = render_passes(scene, 16, seed=1)
    dimmed = render_passes(scene, 16, seed=1, integrator=clamped(scene.integrator(), 2.0))
    assert (dimmed <= plain * (1.0 + 1e-5)).all()
    assert plain.max() > 3.0 > 2.0 >= dimmed.max()
    assert 0.5 < (dimmed == plain).mean() < 1.0


@pytest.mark.parametrize(
    ("integrator", "message"),
    [
        ({"type": "ptracer"}, "if each sample is one path"),
        ({"type": "prb"}, "if each sample is one path"),
        ({"type": "aov", "aovs": "n:sh_normal"}, "also writes other channels"),
    ],
)
def test_clamping_is_refused_for_integrators_whose_samples_are_not_paths(integrator, message):
    with pytest.raises(ParamError, match=message):
        clamped(mi.load_dict(integrator), 1.0)
