"""Writes nma/conductors/conductors.csv: the indices of refraction of real metals, in linear sRGB.

    python tools/make_conductors.py [OUT.csv]

Mitsuba projects every spectrum in its `data/ior` to linear sRGB without bounds, as its `conductor` plugin does. Two
kinds of materials are dropped: transparent crystals, whose absorption k is near 0, and spectra with a negative channel
that the projection had to clamp.
"""

import argparse
from pathlib import Path

import mitsuba as mi
import numpy as np

from nma.files import write_text

OUT = Path(__file__).parents[1] / "nma" / "conductors" / "conductors.csv"
HEADER = ("name", "eta_r", "eta_g", "eta_b", "k_r", "k_g", "k_b", "held_out")

# A material with a lower k than this in any channel is a tinted dielectric. The next material above has .114.
MIN_K = 0.1

# These substances are kept out of training, to test unseen metals: an alkali, a refractory, a bright and a liquid
# metal, a gold-like nitride, one whose eta rises towards blue, a weakly absorbing oxide and amorphous carbon. Mitsuba
# has many substances twice (`Hg`, `Hg_palik`). All rows of a substance are kept out together; otherwise the test would
# contain training data.
HELD_OUT = ("Na", "W", "Rh", "Hg", "TiN", "Ta", "Cu2O", "a-C")


def substance(name: str) -> str:
    """The substance of a data file: `Hg_palik` is `Hg`, `Te-e` (extraordinary ray) is `Te`."""
    return name.removesuffix("_palik").removesuffix("-e")


def project(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Linear sRGB (eta, k), each (3,), of the conductor `name` as Mitsuba's plugin holds it."""
    values = mi.traverse(mi.load_dict({"type": "conductor", "material": name}))
    return np.array(values["eta.value"], float).ravel(), np.array(values["k.value"], float).ravel()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", nargs="?", type=Path, default=OUT)
    out = parser.parse_args().out

    mi.set_variant("scalar_rgb")
    mi.set_log_level(mi.LogLevel.Error)  # Mitsuba warns about every colour that it clamps
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
