"""The changelog's table of changed names: the new names exist, and the old names do not."""

import pkgutil
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TABLE = (ROOT / "CHANGELOG.md").read_text().split("### Names and paths that changed\n")[1].split("\n#")[0]
ROWS = re.findall(r"^\| `([^`]+)` \| `([^`]+)` \| (.*)\|$", TABLE, re.MULTILINE)
STAY = [old for old, _, remark in ROWS if "stays" in remark or "now" in remark]
CPP = " ".join(
    path.read_text() for path in sorted((ROOT / "runtime").rglob("*.*")) if path.suffix in (".h", ".cpp")
)


def exists(name):
    """Whether a name of Python or C++, a path, or a command `python -m MODULE` is there."""
    name = name.split("(")[0]
    if name.startswith("python "):
        module = ROOT.joinpath(*name.removeprefix("python -m ").split("."))
        return "-m" in name and module.with_suffix(".py").is_file()
    if "/" in name:
        return (ROOT / name).exists()
    if "::" in name or name.startswith("nma_"):
        return re.search(rf"\b{name.split('::')[-1]}\b", CPP) is not None
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError):
        return False
    return True


def imported(name):
    """Whether a name of Python is there only because its module imports the name from another module."""
    return exists(name) and not name.startswith(getattr(pkgutil.resolve_name(name), "__module__", "nma"))


def test_every_line_of_the_table_is_a_row():
    assert len(ROWS) == TABLE.count("\n|") - 2 > 40
    assert [old for old, *_ in ROWS] == sorted((old for old, *_ in ROWS), key=str.lower)


@pytest.mark.parametrize(("old", "new", "remark"), ROWS)
def test_the_new_name_is_there_and_the_old_name_is_not(old, new, remark):
    assert exists(new), f"CHANGELOG.md: {new} is not there; correct the row of {old}"
    if old not in STAY and "::" not in old:
        assert not exists(old) or imported(old), (
            f"CHANGELOG.md: {old} is still there; delete its row, or remark that the name stays"
        )
