"""The demonstration shows its first pictures at once, and adds times and errors as soon as they are measured."""

import pytest
from adapter_cases import random_adapter

import nma.render
from nma.images.io import read_image
from nma.render import demo
from nma.render.demo import Settings, total_samples

nma.render.use("llvm_ad_rgb")


@pytest.mark.slow
def test_the_sheet_is_written_before_any_measurement_and_again_with_figures(tmp_path, monkeypatch):
    random_adapter(hidden="1x8").save(tmp_path / "tiny.safetensors")
    settings = Settings((16, 16), 4, 2, 4, str(tmp_path / "tiny.safetensors"))
    path, events = tmp_path / "demo.png", []

    def published(shown):
        events.append((shown, read_image(path).shape[0], sum(samples)))

    samples, measure = [], demo.measure
    monkeypatch.setattr(
        demo, "measure", lambda *args, **more: events.append("measured") or measure(*args, **more)
    )
    lines = demo.demo(path, settings, lambda what, spp: samples.append(spp), published)
    first, second, *measured, plain = events[:6]
    assert (first[0], second[0]) == ("plain, first pictures", "textured, first pictures")
    assert measured == ["measured"] * 3 and plain[0] == "plain, with figures"
    assert events[-1][0] == "textured, with figures"
    # The sheet grows three times, because rows of pictures and lines of the table below them are added.
    heights = [event[1] for event in events if event != "measured"]
    assert heights == sorted(heights) and len(set(heights)) == 4
    assert sum(samples) == total_samples(settings)
    assert [(line.material, line.bsdf) for line in lines] == [
        (material, bsdf) for material in ("plain", "textured") for bsdf in ("principled", "layered", "nma")
    ]
    assert all(line.measured.compile_seconds >= 0.0 for line in lines)
