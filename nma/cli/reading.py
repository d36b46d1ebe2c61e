"""Parses the arguments MATERIAL and SOURCE of the commands, and loads the material or source that they name."""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from nma.cli import console
from nma.errors import ParamError, SourceError, TableError, shown
from nma.files import arrays

if TYPE_CHECKING:
    from nma.materials import Material
    from nma.sources.base import Values
    from nma.table import Tables


def material_of(name: str, changes: list[str] | None) -> Material:
    """Loads a named material, a material file, or the material of an adapter for a single material.

    `changes` are the values of the option --set. The changes apply to a named material or a material file, and are
    ignored for an adapter. Raises `NmaError` if a file cannot be read.
    """
    from nma import materials
    from nma.adapter import Adapter
    from nma.params import MEASURED

    if name.endswith(".safetensors"):
        adapter = Adapter.load(name)
        if adapter.space.size and adapter.material is None:
            raise ParamError(
                f"{name} is an adapter of the whole class {adapter.space.name}; "
                f"name a material, too: nma render MATERIAL --adapter {name}"
            )
        if adapter.material is not None:
            return materials.Material.of_vector(Path(name).stem, adapter.material, adapter.space)
        return materials.Material(Path(name).stem, name, "", MEASURED.name, {})
    material = materials.load(name)
    return material.changed(dict(map(change_of, changes)), "--set") if changes else material


def known_of(
    source: str, material: str | None = None, walks: int = 16_000_000, seed: int = 0
) -> tuple[Values | Tables, dict[str, Any]]:
    """The table or the BRDF values of one material, and a record of their origin.

    A named material or a material file (.toml) is simulated with `walks` random walks, which gives a table. A reference
    file (.npz) contains a table. Any other file that `nma.sources.read` can read gives BRDF values. If a file has
    several materials, `material` selects one material by the name of an NBRDF network or by the index of a table.

    The record has the entries `data` (the kind and the name of the source), `material` (the name of the material) and,
    for tables, `walks_per_material`. Raises `NmaError` if a file cannot be read.
    """
    path = _path(source, material)
    if path.suffix == ".npz":
        return _reference(path, material) if _holds_tables(path) else _values(path, material)
    if is_material(source):
        return _simulated(source, walks, seed)
    return _values(path, None)


def tables_of(
    source: str, material: str | None = None, walks: int = 16_000_000, seed: int = 0
) -> tuple[Tables, dict[str, Any]]:
    """The table of one isotropic material, and the record of its origin, as `known_of` returns them.

    If the source has BRDF values, they are averaged over the bins of a table, and the record also has the number of
    points in each bin, `points_per_bin`. Raises `SourceError` for anisotropic materials.
    """
    from nma.table import Tables
    from nma.table.values import POINTS, tabulate_values

    known, record = known_of(source, material, walks, seed)
    if isinstance(known, Tables):
        return known, record
    if not known.isotropic:
        raise SourceError(
            f"{source}: {known.name} is anisotropic, but only isotropic materials can be fitted"
        )
    began = time.perf_counter()
    tables = tabulate_values(known, points=POINTS)
    console.say(f"tabulated {known.name} in {time.perf_counter() - began:.1f} s")
    return tables, {**record, "points_per_bin": POINTS}


def values_of(source: str, material: str | None, adapter: str, clamp: bool = False) -> Values:
    """The source that `source` names, which has a BRDF value at every pair of directions.

    `source` is a file of BRDF values, a weights file (.safetensors) of an adapter for a single material, or a named
    material or a material file (.toml). The BRDF of a named material or a material file is computed by the adapter
    `adapter`. `clamp` moves the material's parameters into the training range of this adapter.

    Raises `NmaError` if a file cannot be read, or if `source` is a reference file, whose tables contain only means over
    bins.
    """
    from nma import materials
    from nma.adapter import Adapter
    from nma.adapter.values import AdapterValues

    path = _path(source, material)
    if path.suffix == ".npz" and path.is_file() and _holds_tables(path):
        raise TableError(
            f"{path} holds tables, whose bins are too wide for single BRDF values; "
            f"fit an adapter first: nma fit {path} -o X.safetensors"
        )
    if path.suffix == ".safetensors":
        return AdapterValues(Adapter.load(path), name=path.stem)
    if is_material(source):
        known, network = materials.load(source), Adapter.load(adapter)
        network.check_class(known.class_name, source, adapter)
        return AdapterValues(network, network.check(known.vector(), clamp)[0], known.name)
    return _values(path, material)[0]


def is_material(source: str) -> bool:
    """Whether `source` is the name of a named material or the path of a material file (.toml)."""
    from nma import materials

    return Path(source).suffix in ("", ".toml") or source in materials.names()


def _path(source: str, material: str | None) -> Path:
    path = Path(source)
    if material is not None and path.suffix != ".npz":
        raise typer.BadParameter(
            f"--material selects a material of an .npz file, but {source} is a single material"
        )
    return path


def _simulated(name: str, walks: int, seed: int) -> tuple[Tables, dict[str, Any]]:
    from nma import materials, sources
    from nma.table import stream_keys, tabulate

    material = materials.load(name)
    vector = material.vector()
    began = time.perf_counter()
    source = sources.get(material.class_name)
    tables = tabulate(source, vector[None], walks, stream_keys(seed, range(1)), error=False)
    console.say(f"simulated {walks:,} walks in {time.perf_counter() - began:.1f} s")
    record = {"data": f"material {name}", "material": material.name, "walks_per_material": walks}
    return tables, record


def _values(path: Path, material: str | None) -> tuple[Values, dict[str, Any]]:
    from nma import sources

    values = sources.read(path, material)
    return values, {"data": f"values of {path.name}", "material": material or path.stem}


def _reference(path: Path, material: str | None) -> tuple[Tables, dict[str, Any]]:
    from nma import sources
    from nma.table import Tables

    tables = Tables.load(path)
    if tables.class_name not in sources.classes():
        raise TableError(
            f"{path}: its materials are of class {shown(tables.class_name)}, but this version has only "
            f"{', '.join(sources.classes())}; use the version that wrote the file"
        )
    number = _number(path, len(tables.values), material)
    chosen = tables[number : number + 1]
    try:
        chosen.check_params()
    except ParamError as e:
        raise TableError(f"{path}: material {number}: {e}") from None
    record = {
        "data": f"table of {path.name}",
        "material": f"{path.stem} {number}" if len(tables.values) > 1 else path.stem,
        "walks_per_material": int(chosen.walks[0]),
    }
    return chosen, record


def _number(path: Path, count: int, material: str | None) -> int:
    """The index of the material that `material` selects from a reference file with `count` materials."""
    if material is None and count == 1:
        return 0
    if material is None or not re.fullmatch(r"\d{1,9}", material, re.ASCII) or int(material) >= count:
        given = "" if material is None else f", not {material!r}"
        raise TableError(
            f"{path} contains {count} material(s); choose one with --material 0 .. {count - 1}{given}"
        )
    return int(material)


def _holds_tables(path: Path) -> bool:
    """Whether an .npz file is a reference file: only files of NBRDF networks have an array `weights`."""
    try:
        with arrays(path) as f:
            return "weights" not in f
    except Exception:  # the file is read again later, where its fault is reported
        return True


def change_of(text: str) -> tuple[str, Any]:
    """Parses a change such as `alpha_top=.2` and returns the name and the value, as a material file gives them."""
    name, value = assignment(text)
    try:
        numbers = [float(part) for part in value.split(",")]
        return name, numbers if len(numbers) > 1 else numbers[0]
    except ValueError:
        return name, value if name == "conductor" or value.startswith("#") else _texture(value)


def _texture(text: str) -> dict[str, Any]:
    """Parses `orm.png,channel=g,uv_scale=4` to the TOML table of a texture. The image's name may contain commas."""
    from nma.materials import TEXTURE_OPTIONS

    file, *parts = re.split(rf",(?=(?:{'|'.join(TEXTURE_OPTIONS)})=)", text)
    return {"texture": file} | {key: _option(value) for key, _, value in (p.partition("=") for p in parts)}


def _option(text: str) -> Any:
    try:
        return float(text)
    except ValueError:
        return {"true": True, "false": False}.get(text, text)


def assignment(text: str) -> tuple[str, str]:
    """Parses `NAME=VALUE` and returns the name and the value."""
    name, equals, value = text.partition("=")
    if not (equals and name and value):
        raise typer.BadParameter(f"'{text}' is not of the form NAME=VALUE")
    return name.strip(), value.strip()
