"""Paper Table 5 and Fig. 11: the adapters compared with a network of a million weights that evaluates f directly.

    python -m figures.direct.run [--quick] [--data FOLDER.zarr] [--steps N] [--latent-steps N]

First trains a direct evaluator on the adapters' dataset: a decoder, and a latent code for each material (evaluator.py).
Then fits latent codes for the 89 validation materials to the materials' own references, as the paper does for Fan et
al. 2022. The adapters were not trained on the validation materials, but compute the BRDF from the materials'
parameters. The direct evaluator and the adapters are evaluated at random points in every bin, and the values are
averaged over each bin. A killed training continues from its checkpoint in out/figures/direct.

Writes direct.json, direct.md and direct.png beside this file. With --quick, trains a small network and writes to
out/figures/direct.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import nma
from figures import common
from figures.direct import evaluator as direct
from nma import network
from nma.adapter import encoding
from nma.cli import console
from nma.evaluate.metrics import mean_metrics, table_metrics
from nma.files import write_text
from nma.ops import Vec3
from nma.table import ISOTROPIC, quadrature
from nma.table.dataset import Settings, simulate_block

SET = "range"
NETWORK, QUICK_NETWORK = "5x512", "2x32"
# Points per bin for the adapters (as in the paper) and for the direct evaluator. The direct evaluator is slow, and its
# values vary little within a bin, so it is evaluated at fewer points.
POINTS, DIRECT_POINTS = 10, 2
# The number of points that are evaluated at a time.
BATCH = 8192
# The paper has 40 x 80 x 40 x 80 bins with 10 points each.
PAPER_POINTS = 40 * 80 * 40 * 80 * 10
COLUMNS = {
    "ae": "AE",
    "psnr": "PSNR",
    "smape": "SMAPE",
    "log_loss": "log loss",
    "albedo_error": "albedo error",
}
# The paper's Table 5, measured on an RTX 4090.
PAPER = {
    "paper: NMA 5x64": {"ae": 0.0065, "psnr": 45.5, "smape": 0.100, "log_loss": 0.0037, "seconds": 3.76},
    "paper: Fan et al.": {"ae": 0.0130, "psnr": 39.7, "smape": 0.257, "log_loss": 0.0100, "seconds": 99.78},
}
# A function of a material's index, wi and wo (n,) that returns f cos(theta_o) (n, 3).
Evaluate = Callable[[int, Vec3, Vec3], NDArray]


def main() -> None:
    parser = common.parser(__doc__)
    parser.add_argument("--data", type=Path, default=common.ROOT / "out/layered3.zarr", help="a dataset")
    parser.add_argument("--steps", type=int, default=4000, help="steps of the direct evaluator's training")
    parser.add_argument(
        "--latent-steps", type=int, default=1500, help="steps for the validation materials' latents"
    )
    arguments = parser.parse_args()
    if arguments.quick:
        vars(arguments).update(steps=50, latent_steps=50)
    folder = common.results(__file__, arguments.quick)
    reference = common.reference(SET, arguments.quick)
    trained, how = train(arguments, reference)
    results = {}
    for name in nma.shipped():
        adapter = nma.Adapter.load(name)
        evaluate = of_adapter(adapter, reference.params)
        results[name] = judge(evaluate, reference, POINTS)
        results[name] |= {
            "exact": figures(common.figures(adapter, reference)),
            "parameters": network.parameters(adapter.layers),
        }
        print_means(name, results[name])
    label = "direct evaluator"
    results[label] = judge(of_evaluator(trained), reference, DIRECT_POINTS)
    results[label] |= {"parameters": network.parameters(trained.decoder), **how}
    print_means(label, results[label])
    text = markdown(results)
    print(text)
    write_text(folder / "direct.md", text)
    common.write_json(folder / "direct.json", results)
    plot(results, folder / "direct.png")


def train(arguments: Any, reference: nma.Tables) -> tuple[direct.Evaluator, dict[str, Any]]:
    """Returns the evaluator with latent codes of the validation materials, and the number of bins and the seconds of
    its training."""
    quick, kept = arguments.quick, common.ROOT / "out/figures/direct"
    kept.mkdir(parents=True, exist_ok=True)
    settings, tables = data(arguments.data, quick)
    how = direct.recipe(arguments.steps, QUICK_NETWORK if quick else NETWORK)
    # The decoder's training does not depend on the validation set, so `stem` does not contain the set's name.
    stem = f"{how.network}_{settings.materials}_{how.steps}-steps"
    record: dict[str, Any] = {"dataset": asdict(settings)}
    with console.TrainingBar(how, "decoder") as bar:
        whole, run = direct.train(tables, how, record, kept / f"{stem}.ckpt", bar.update)
    again = direct.recipe(arguments.latent_steps, how.network)
    record |= {"decoder": how.steps, "validation": f"{SET}-{len(reference.params)}"}
    path = kept / f"{stem}_{again.steps}-latent-steps.ckpt"
    with console.TrainingBar(again, "latents") as bar:
        fitted, fit = direct.train(reference, again, record, path, bar.update, whole.decoder)
    took: dict[str, Any] = {
        "bins_seen": how.steps * how.bins_per_step,
        "training_seconds": round(run.seconds),
    }
    return fitted, took | {"latent_seconds_per_material": round(fit.seconds / len(reference.params), 2)}


def data(path: Path, quick: bool) -> tuple[Settings, nma.Tables]:
    if quick:
        settings = Settings("layered3", 16, 81_920, 0)
        return settings, simulate_block(settings, range(16))
    dataset = nma.Dataset.open(path)
    return dataset.settings, dataset.load()


def of_adapter(adapter: nma.Adapter, params: NDArray) -> Evaluate:
    """Returns a function that evaluates the adapter and runs the adapter's network at every point, as in the paper."""
    encode, materials = encoding.get(adapter.encoding), params.astype(np.float32)

    def at_points(material: jax.Array, wi: Vec3, wo: Vec3) -> jax.Array:
        inputs = [jnp.broadcast_to(x, wi.z.shape) for x in encode(list(material), wi)]
        raw = network.forward(adapter.layers, jnp.stack(inputs, axis=-1))
        return jnp.stack(adapter.decode(list(raw.T), wi, list(material)).eval(wi, wo), axis=-1)

    run = batched(at_points)
    return lambda number, wi, wo: run(materials[number], wi, wo)


def of_evaluator(trained: direct.Evaluator) -> Evaluate:
    run = batched(lambda latent, wi, wo: direct.evaluate(trained.decoder, latent, wi, wo))
    return lambda number, wi, wo: run(trained.latents[number], wi, wo)


def batched(at_points: Callable[[Any, Vec3, Vec3], jax.Array]) -> Callable[[Any, Vec3, Vec3], NDArray]:
    """Compiles `at_points`, and returns a function that calls the compiled function for all points, in batches that fit
    into a CPU's cache."""

    @jax.jit
    def compiled(material: Any, wi: Vec3, wo: Vec3) -> jax.Array:
        return jax.lax.map(lambda pair: at_points(material, *pair), (wi, wo))

    def run(material: Any, wi: Vec3, wo: Vec3) -> NDArray:
        size = wi.z.size
        length = -(-size // BATCH) * BATCH
        wi, wo = (Vec3(*(np.resize(x, length).reshape(-1, BATCH) for x in v)) for v in (wi, wo))
        return np.asarray(compiled(material, wi, wo)).reshape(-1, 3)[:size]

    return run


def judge(evaluate: Evaluate, reference: nma.Tables, per_bin: int) -> dict[str, Any]:
    """Returns the metrics of every material, the mean metrics, and the seconds for PAPER_POINTS points."""
    i, o, p = np.stack(np.unravel_index(np.arange(ISOTROPIC.bins), ISOTROPIC.shape[:3])).astype(np.float32)
    assert reference.error is not None
    materials, seconds = [], []
    for number, table in enumerate(reference.values):
        u = np.random.default_rng((0x7AB1E5, number)).random((3, per_bin, ISOTROPIC.bins), np.float32)
        points = quadrature.uniform_bin_points(i, o, p, (u[0], u[1], u[2]))
        wi = Vec3(*(np.broadcast_to(x, points.wo.z.shape) for x in points.wi))
        began = time.perf_counter()
        value = evaluate(number, wi, points.wo)
        seconds.append((time.perf_counter() - began) / points.wo.z.size)
        mean = value.reshape(per_bin, *ISOTROPIC.shape).mean(axis=0)
        materials.append(table_metrics(mean, table, reference.error[number]))
    rounded = [{k: round(m[k], 6) for k in COLUMNS} for m in materials]
    means = {k: round(v, 6) for k, v in mean_metrics(materials).items()}
    # The time of the first material includes compilation, but the median ignores this outlier.
    return {
        "mean": means,
        "seconds": round(float(np.median(seconds)) * PAPER_POINTS, 2),
        "materials": rounded,
    }


def figures(materials: list[dict[str, float]]) -> dict[str, Any]:
    """Returns the rounded metrics of every material, and their means."""
    rounded = [{k: round(m[k], 6) for k in COLUMNS} for m in materials]
    return {"mean": {k: round(v, 6) for k, v in mean_metrics(materials).items()}, "materials": rounded}


def print_means(name: str, result: dict[str, Any]) -> None:
    print(name, {k: result["mean"][k] for k in COLUMNS}, f"{result['seconds']} s", flush=True)


def markdown(results: dict[str, Any]) -> str:
    """Returns a Markdown table with our results, and below these the results of the paper's Table 5."""
    lines = ["| | " + " | ".join(COLUMNS.values()) + " | time, s | parameters |", "|---" * 8 + "|"]
    for name, result in results.items():
        cells = [f"{result['mean'][k]:.4g}" for k in COLUMNS]
        cells += [f"{result['seconds']:.4g}", f"{result['parameters']:,}"]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
        if "exact" in result:
            cells = [f"{result['exact']['mean'][k]:.4g}" for k in COLUMNS]
            lines.append(f"| {name}, converged bin means | " + " | ".join(cells) + " | | |")
    for name, row in PAPER.items():
        cells = [f"{row[k]:.4g}" if k in row else "" for k in COLUMNS]
        lines.append(f"| {name} | " + " | ".join([*cells, f"{row['seconds']:.4g}", ""]) + " |")
    noise = next(iter(results.values()))["mean"]["noise_floor"]
    return "\n".join(lines) + f"\n\nThe noise of the references alone gives a log loss of {noise:.5f}.\n"


def plot(results: dict[str, Any], path: Path) -> None:
    """Plots AE and log loss of every material, sorted by the direct evaluator's AE (Fig. 11)."""
    curves: dict[str, tuple[list, dict[str, Any]]] = {}
    for name, result in results.items():
        if "exact" in result:
            curves[f"{name}, {POINTS} points per bin"] = (result["materials"], {"linewidth": 0.5})
            curves[f"{name}, converged"] = (result["exact"]["materials"], {"marker": "."})
        else:
            curves[name] = (result["materials"], {"marker": "."})
    order = np.argsort([m["ae"] for m in curves[next(iter(reversed(curves)))][0]])
    figure = Figure(figsize=(10, 7), layout="constrained")
    for axes, quantity in zip(figure.subplots(2, 1, sharex=True), ("ae", "log_loss"), strict=True):
        for name, (materials, style) in curves.items():
            values = np.array([m[quantity] for m in materials])
            axes.plot(values[order], label=f"{name}: {values.mean():.4f}", **{"linewidth": 0.9} | style)
        axes.set(yscale="log", ylabel="absolute error [1/sr]" if quantity == "ae" else "log loss (eq. 7)")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    figure.axes[-1].set_xlabel("validation materials, by the direct evaluator's absolute error")
    common.save_figure(figure, path)


if __name__ == "__main__":
    main()
