"""Short surveys from Python, in parallel, compared by estimator.

python examples/hundred_flights.py --flights 100 --out runs/hundred

Flights that are there already are not flown again, so that it goes on where it was stopped.
`touchdown campaign` does the same with limits, a forecast and reports.
"""

import argparse
import multiprocessing
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path

import matplotlib

matplotlib.use("agg")  # a file, no window
import matplotlib.pyplot as plt

import touchdown

ESTIMATORS = ("livo", "gps")


def fly(out: Path, estimator: str, seed: int) -> str:
    if not (out / "result.json").is_file():
        touchdown.fly(
            "crossroad",
            estimator=estimator,
            seed=seed,
            out=out,
            overrides={"preset": "short", "record": False, "sim.threads": 1},
        )
    return out.name


def compare(out: Path) -> dict[str, list[float]]:
    """Writes a plot; returns the mean position errors of the completed flights, in metres."""
    errors: dict[str, list[float]] = {}
    lost: dict[str, int] = {}
    for run in touchdown.load_runs(out):
        found = errors.setdefault(run.estimator, [])
        if run.is_success and run.position_error_m is not None:
            found.append(run.position_error_m.mean)
        else:  # a flight that ended early has no mean error to compare
            lost[run.estimator] = lost.get(run.estimator, 0) + 1
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    names = [
        f"{name}\n{len(found)} completed, {lost.get(name, 0)} not" for name, found in errors.items()
    ]
    axes.boxplot(list(errors.values()), tick_labels=names)
    for column, found in enumerate(errors.values(), start=1):
        axes.plot([column] * len(found), found, ".", alpha=0.5)
    axes.set(ylabel="mean position error (m)", yscale="log", title="short surveys of crossroad")
    figure.savefig(out / "errors.png", dpi=120)
    return errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", type=int, default=100, help="half with each estimator")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="flights at a time")
    parser.add_argument("--out", type=Path, default=Path("runs/hundred"))
    given = parser.parse_args()
    seeds = range(-(-given.flights // len(ESTIMATORS)))
    flights = [(e, seed) for seed in seeds for e in ESTIMATORS][: given.flights]
    # Spawned, not forked: a fork would share the state of the renderer.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(given.jobs, mp_context=spawn) as pool:
        waiting = [pool.submit(fly, given.out / f"{e}-{seed}", e, seed) for e, seed in flights]
        for number, flown in enumerate(as_completed(waiting), start=1):
            print(f"{number} of {len(waiting)}: {flown.result()}", flush=True)
    for estimator, errors in compare(given.out).items():
        if errors:
            mean = sum(errors) / len(errors)
            print(f"{estimator}: {mean:.3f} m, mean of {len(errors)} completed flights")
    print(given.out / "errors.png")


if __name__ == "__main__":
    main()
