"""pytest plugin: flies an estimator over scenes and seeds in a test and bounds its error.

Installed with the project; ``-p no:touchdown`` turns it off. It imports nothing but pytest at load
time, since pytest loads it in every project.
"""

import functools
import itertools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

Rows = list[dict[str, Any]]
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("touchdown", "flights of Touchdown")
    group.addoption(
        "--touchdown-jobs",
        type=int,
        default=1,
        metavar="N",
        help="processes that fly at a time (default: 1, in the process of the tests)",
    )
    group.addoption(
        "--touchdown-out",
        type=Path,
        default=None,
        metavar="DIR",
        help="keep the run directories there, for `touchdown report` and `touchdown regress`",
    )


@pytest.fixture(scope="session")
def touchdown_flights(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Callable[..., Rows]:
    """Returns a function that flies and returns one row per flight: `fly_all` with the folder and
    the number of processes of the options."""
    out = request.config.getoption("--touchdown-out") or tmp_path_factory.mktemp("touchdown")
    jobs = request.config.getoption("--touchdown-jobs")

    return functools.partial(fly_all, out=out, jobs=jobs)


def fly_all(
    estimator: str,
    *,
    out: Path,
    scenes: Iterable[str] = ("crossroad",),
    seeds: Iterable[int] = (0,),
    mode: str = "fly",
    overrides: Sequence[str] = (),
    jobs: int = 1,
) -> Rows:
    """Flies an estimator over every scene with every seed.

    ``estimator`` is a name or ``module:function``; ``mode`` ``"fly"`` (the survey alone) or
    ``"land"``; ``overrides`` are ``key=value`` strings as after ``--set``. Run directories appear
    below ``out``. The rows are in the order of scenes and seeds, whatever ``jobs``; their keys are
    those of ``result.json`` with dots between them, such as ``position_error_m.mean``. A flight
    that raises becomes a row with the outcome ``CRASHED`` and its error as the reason.

    Raises UsageError for a mistake in the arguments, before the first flight.
    """
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    from touchdown.experiments.config.loading import load_config
    from touchdown.experiments.errors import UsageError
    from touchdown.experiments.flight.slots import check_parts_available
    from touchdown.experiments.flight.wiring import check_estimator_name
    from touchdown.scenes.api import short_name

    if mode not in ("fly", "land"):
        raise UsageError(f"mode = '{mode}' must be 'fly' or 'land'")
    if jobs < 1:
        raise UsageError(f"--touchdown-jobs {jobs} must be 1 or more")
    check_estimator_name(estimator)
    tasks = []
    for scene, seed in itertools.product(scenes, seeds):
        config = load_config(
            None, ["sim.threads=1", "record=false", *overrides],
            scene=scene, seed=seed, estimator=estimator, survey_only=mode == "fly",
        )  # fmt: skip
        check_parts_available(config)
        name = f"{short_name(scene)}-{estimator.replace(':', '.')}-s{seed}"
        tasks.append((config.model_dump_json(), str(out / name), mode))
    if jobs == 1 or len(tasks) == 1:
        return [_fly_one(task) for task in tasks]
    # Spawned: a fork would inherit OpenGL contexts and threads of the test process.
    with ProcessPoolExecutor(
        min(jobs, len(tasks)), mp_context=get_context("spawn"), initializer=_one_thread
    ) as pool:
        return list(pool.map(_fly_one, tasks))


def _one_thread() -> None:
    """Limits numerical libraries of a worker to one core, before they are imported."""
    os.environ.update(dict.fromkeys(_THREADS, "1"))


def _fly_one(task: tuple[str, str, str]) -> dict[str, Any]:
    from touchdown.experiments.campaign.plan import config_sha
    from touchdown.experiments.campaign.results_table import CRASHED, make_row
    from touchdown.experiments.config.schema import Config
    from touchdown.experiments.errors import ExternalPartError, UsageError
    from touchdown.experiments.flight.run import fly_with_usage_errors
    from touchdown.experiments.io.results import RunResult
    from touchdown.sim.opengl import rendering_backend

    os.environ.setdefault("MUJOCO_GL", rendering_backend())
    text, out, mode = task
    config = Config.model_validate_json(text)
    try:
        result = fly_with_usage_errors(config, Path(out), lambda *_: None)
    except Exception as error:
        external = isinstance(error, ExternalPartError)
        if isinstance(error, UsageError) and not external:
            raise
        result = RunResult(
            outcome=CRASHED,
            reason=str(error) if external else f"{type(error).__name__}: {error}",
            scene=config.scene,
            seed=config.seed,
            estimator=config.estimator,
            wind_kmh=config.wind.mean_kmh,
        )
    return make_row(result, Path(out).name, mode, config_sha(config))


def assert_position_error(
    rows: Iterable[Mapping[str, Any]], *, below: float, key: str = "position_error_m.mean"
) -> None:
    """Fails unless every flight was successful with less than ``below`` at ``key``.

    The message names each flight that does not. Raises ValueError without any flight.
    """
    from touchdown.experiments.campaign.results_table import is_successful
    from touchdown.experiments.reporting.flights import number

    __tracebackhide__ = True  # pytest shows the test's line, not this function
    flights = list(rows)
    if not flights:
        raise ValueError("assert_position_error was given no flight")
    failed = []
    for row in flights:
        error = number(row, key)
        who = f"{row['scene']}, {row['estimator']}, seed {row['seed']}"
        if not is_successful(row):
            failed.append(f"{who}: {row['outcome']} ({row.get('reason') or 'no reason given'})")
        elif error is None or not error < below:
            failed.append(f"{who}: {key} = {error if error is None else f'{error:.4g}'}")
    if failed:
        raise AssertionError(
            f"{len(failed)} of {len(flights)} flights are not below {below:g}:\n  "
            + "\n  ".join(failed)
        )
