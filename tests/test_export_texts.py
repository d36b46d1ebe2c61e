"""Every text format of `nma principled -o` describes the fitted BRDF, and the format's renderer reads the description.

The tests loop over `TEXTS` of nma/export, so they also test a new format.
"""

import json

import numpy as np
import pytest
from target_cases import random_directions, random_principled, stacked

from nma import export
from nma.export import TEXTS, Text, principled_text
from nma.jit import dr
from nma.ops import Color, Vec3
from nma.sources.mitsuba_bsdf import from_dict, from_string
from nma.target import Principled, eval_principled

# For each format, the function that returns the source of a text: the source's method `eval` returns the values of
# the BRDF that the text describes. A format has None if no renderer of the tests reads the format.
READERS = {".xml": from_string, ".json": lambda text: from_dict(json.loads(text))}


def brdfs():
    """Returns random BRDFs, which an adapter's targets could have, and a BRDF whose numbers are all 0."""
    many = random_principled(np.random.default_rng(8), 3)
    drawn = [
        Principled(Color(*(float(c[n]) for c in many.base_color)), *(float(x[n]) for x in many[1:11]))
        for n in range(3)
    ]
    limited = [p._replace(clearcoat_gloss=min(p.clearcoat_gloss, 0.8)) for p in drawn]
    return [*limited, Principled(Color(0.0, 0.0, 0.0), *[0.0] * 8)._replace(roughness=0.5)]


def check(ending):
    """Writes BRDFs in the format `ending`, reads the texts back, and compares values above the horizon, within 1e-3."""
    assert ending in READERS, (
        f"the tests cannot read {ending} files: add a line for '{ending}' to READERS in tests/test_export_texts.py"
    )
    assert TEXTS[ending].renderer, f"{ending}: name the renderer in TEXTS of nma/export/__init__.py"
    texts = [principled_text(ending, p) for p in brdfs()]
    for text in texts:
        assert text.strip() and text.endswith("\n"), (
            f"{ending}: the text is empty or its last line does not end"
        )
    assert len(set(texts)) == len(texts), f"{ending}: two BRDFs have the same text"
    if (read := READERS[ending]) is None:
        return
    rng = np.random.default_rng(9)
    wi, wo = random_directions(rng, 1000), random_directions(rng, 1000)
    compared = (wi.z > 0.02) & (wo.z > 0.02)
    for p, text in zip(brdfs(), texts, strict=True):
        value = stacked(Vec3(*(c.numpy() for c in read(text).eval(lanes(wi), lanes(wo)))))
        expected = stacked(eval_principled(p, wi, wo))
        np.testing.assert_allclose(value[:, compared], expected[:, compared], rtol=1e-3, atol=1e-6)


def lanes(w):
    return Vec3(*(dr.auto.Float(np.asarray(x, np.float32)) for x in w))


@pytest.mark.parametrize("ending", TEXTS)
def test_the_renderer_of_a_format_reads_what_is_written(ending):
    check(ending)


def raises(principled):
    raise RuntimeError("a printer that fails")


@pytest.mark.parametrize(
    ("printer", "error"),
    [
        (raises, RuntimeError),
        (lambda p: "", AssertionError),
        (lambda p: "the same\n", AssertionError),
        (lambda p: export.mitsuba.principled_json(p._replace(roughness=1.0)), AssertionError),
    ],
    ids=["raises", "empty", "always the same", "wrong roughness"],
)
def test_a_faulty_format_is_found(printer, error, monkeypatch):
    monkeypatch.setattr("nma.export.mitsuba.faulty", printer, raising=False)
    monkeypatch.setitem(TEXTS, ".faulty.json", Text("Mitsuba", "mitsuba:faulty"))
    with pytest.raises(AssertionError, match="add a line for '.faulty.json' to READERS"):
        check(".faulty.json")
    monkeypatch.setitem(READERS, ".faulty.json", READERS[".json"])
    with pytest.raises(error):
        check(".faulty.json")
