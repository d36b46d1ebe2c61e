"""Rules for every source that can be evaluated: values near the horizon, and the error for a missing file."""

import math
import sys
import types

import numpy as np
import pytest
from adapter_cases import materials, random_adapter
from source_cases import direction, numbers

from nma import sources
from nma.adapter.values import AdapterValues
from nma.errors import SourceError
from nma.sources import catalogue
from nma.sources.coating import Coating
from nma.sources.files import Format
from nma.sources.merl import SHAPE, Merl
from nma.sources.mitsuba_bsdf import from_dict
from nma.sources.nbrdf import WEIGHTS, Nbrdf
from nma.table import collection

SOURCES = {
    "coating": lambda: Coating(absorption=(0.0, 0.1, 0.3)),
    "merl": lambda: Merl(np.ones((3, *SHAPE))),
    "nbrdf": lambda: Nbrdf(np.random.default_rng(0).normal(size=WEIGHTS).astype(np.float32) * 0.1),
    "adapter": lambda: AdapterValues(random_adapter(hidden="1x8"), materials(1)[0]),
    "roughplastic": lambda: from_dict({"type": "roughplastic"}),
    "roughconductor": lambda: from_dict({"type": "roughconductor", "alpha": 0.01}),
    "principled": lambda: from_dict({"type": "principled", "clearcoat": 1.0, "roughness": 0.1}),
}
COSINES = (0.0, 1e-30, 1e-12, 1e-8, 1e-7, 1e-5, 1e-3)


def grazing(cosines, n=500):
    """Returns pairs of directions. In each pair, at least one direction has a cosine from `cosines`.

    The azimuths of a pair are equal, opposite, or 1 rad apart.
    """
    rng, pairs = np.random.default_rng(0), []
    for cosine in cosines:
        for one, other in ((cosine, cosine), (cosine, 0.5), (0.5, cosine)):
            for apart in (0.0, 1.0, math.pi):
                phi = rng.uniform(0.0, 2.0 * math.pi, n)
                spread = np.where(rng.random(n) < 0.5, 0.0, 1e-6 * rng.normal(size=n))
                pairs.append(np.broadcast_arrays(one, phi, other, phi + apart + spread))
    mu_i, phi_i, mu_o, phi_o = np.concatenate(pairs, axis=-1)
    return direction(mu_i, phi_i), direction(mu_o, phi_o)


def assert_finite(source, largest):
    wi, wo = grazing(COSINES)
    values = numbers(source.eval(wi, wo))
    assert np.isfinite(values).all()
    assert np.abs(values).max() < largest
    assert not values[(wi.z.numpy() == 0) | (wo.z.numpy() == 0)].any()


@pytest.mark.parametrize("name", SOURCES)
def test_values_at_the_horizon_are_finite(name):
    assert_finite(SOURCES[name](), 1e8)


@pytest.mark.parametrize("name", ("paper_white", "cg_sunflower"))
def test_measured_values_at_the_horizon_are_finite(measurements, name):
    """Values at the horizon are at most 10 % larger than the forward peak slightly above the horizon."""
    source = sources.read(measurements / "rgl" / f"{name}_rgb.bsdf")
    peak = numbers(source.eval(*grazing((1e-4, 1e-3, 1e-2)))).max()
    assert_finite(source, 1.1 * peak)


@pytest.mark.parametrize("ending", sources.FORMATS)
@pytest.mark.parametrize("name", ["none", "x" * 300, "a\0b"])
@pytest.mark.parametrize("material", [None, "gold"])
def test_of_a_file_that_is_not_there_nothing_else_is_said(tmp_path, ending, name, material):
    with pytest.raises(SourceError) as error:
        sources.read(tmp_path / f"{name}{ending}", material)
    message = str(error.value).removeprefix(f"{tmp_path}/{name}{ending}: ")
    if name == "none":
        assert message.startswith("no such file")
    assert "many" not in message and "\n" not in message


@pytest.mark.parametrize("ending", sources.FORMATS)
@pytest.mark.parametrize("content", [b"", b"PK", b"<bsdf", bytes(100)], ids=("empty", "zip", "xml", "zeros"))
def test_a_damaged_file_of_any_format_is_refused_by_all_who_read_it(tmp_path, ending, content):
    path = tmp_path / f"gold{ending}"
    path.write_bytes(content)
    form = sources.format_of(path)
    readers = [lambda: sources.read(path, "gold"), form.identify and (lambda: form.identify(path))]
    readers += [form.names and (lambda: form.names(path))]
    for read in filter(None, readers):
        with pytest.raises(SourceError, match=f"gold{ending}: "):
            read()


@pytest.mark.parametrize("ending", sources.FORMATS)
def test_every_format_with_measurements_tells_which_a_file_is_of(ending):
    form = sources.formats()[ending]
    assert bool(form.measurements) == bool(form.identify)
    assert all(measured in catalogue.MEASUREMENTS for measured in form.measurements)
    for measured in form.measurements:
        assert ending in measured.files and measured.name.startswith(form.name)
        assert all(name.endswith(ending) for name in measured.known)


def test_a_new_format_is_a_file_and_a_line(monkeypatch, tmp_path):
    """Files of a registered format can be read and collected, and error messages list the format."""
    module = types.ModuleType("nma.sources.grey")
    module.FORMAT = Format("Grey", lambda path: Coating(alpha=float(path.read_text())))
    monkeypatch.setitem(sys.modules, "nma.sources.grey", module)
    monkeypatch.setitem(sources.FORMATS, ".grey", "grey:FORMAT")
    (tmp_path / "dull.grey").write_text("0.5")
    assert sources.read(tmp_path / "dull.grey").alpha == 0.5
    (member,) = collection.members(tmp_path)
    assert (member.name, member.read().alpha, collection.origin([member])) == ("dull", 0.5, "*.grey")
    with pytest.raises(SourceError, match=r"files end in .*\.grey"):
        sources.read("dull.gray")
