"""Writes nma/conductors/conductors.csv, which contains the refractive indices of real metals in linear sRGB.

    python tools/make_conductors.py [OUT.csv]

Mitsuba's plugin `conductor` projects the spectra in its folder `data/ior` to linear sRGB, and this script reads the
projected values. The script omits transparent crystals, whose absorption k is near 0, and spectra whose projection has
a negative channel, which Mitsuba clamps to 0.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

from nma.files import write_text

OUT = Path(__file__).parents[1] / "nma" / "conductors" / "conductors.csv"
HEADER = ("name", "eta_r", "eta_g", "eta_b", "k_r", "k_g", "k_b", "held_out")

# A material whose k is below MIN_K in any channel is a tinted dielectric, and is omitted. The smallest k of the
# remaining materials is .114.
MIN_K = 0.1

# The substances in HELD_OUT are not used for training, so that adapters can be tested on unseen metals. HELD_OUT has an
# alkali metal, a refractory metal, a bright metal, a liquid metal, a nitride that looks like gold, a metal whose eta
# rises towards blue, a weakly absorbing oxide, and amorphous carbon. Mitsuba has several data files for some substances
# (`Hg`, `Hg_palik`). None of the files of a test substance is used for training; otherwise the test would contain
# training data.
HELD_OUT = ("Na", "W", "Rh", "Hg", "TiN", "Ta", "Cu2O", "a-C")


def substance(name: str) -> str:
    """The substance of a data file: `Hg` for `Hg_palik`, and `Te` for `Te-e` (the extraordinary ray of tellurium)."""
    return name.removesuffix("_palik").removesuffix("-e")


def project(name: str) -> tuple[np.ndarray, np.ndarray]:
    """The refractive index (eta, k) of the conductor `name` in linear sRGB, as Mitsuba projects it; each (3,)."""
    values = mi.traverse(mi.load_dict({"type": "conductor", "material": name}))
    return np.array(values["eta.value"], float).ravel(), np.array(values["k.value"], float).ravel()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", nargs="?", type=Path, default=OUT)
    out = parser.parse_args().out

    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)  # no warnings about clamped colours
    files = (Path(mi.__file__).parent / "data" / "ior").glob("*.eta.spd")
    names = sorted((f.name.removesuffix(".eta.spd") for f in files), key=lambda name: (name.lower(), name))

    source = f"Mitsuba {mi.__version__} data/ior"
    lines = [f"# Linear sRGB (eta, k) of {source}; written by tools/make_conductors.py", ",".join(HEADER)]
    for name in names:
        eta, k = project(name)
        if eta.min() > 0 and k.min() > MIN_K:
            numbers = (f"{x:.7g}" for x in (*eta, *k))
            lines.append(",".join([name, *numbers, str(int(substance(name) in HELD_OUT))]))
    write_text(out, "\n".join([*lines, ""]))
    print(f"{out}: {len(lines) - 2} of {len(names)} conductors")


if __name__ == "__main__":
    main()
