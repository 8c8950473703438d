"""The commands of `freqgs bench`. Heavy imports happen inside of them."""

import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from freqgs_plugin.reports.bench.options import BenchError, BenchOptions

Options = Annotated[BenchOptions, tyro.conf.arg(name="")]


def raster(options: Options = BenchOptions()) -> None:  # noqa: B008
    """Time every backend, and measure its memory; all prefixes in one pass; less detail against everything."""
    from freqgs_plugin.reports.bench.raster import raster_bench
    from freqgs_plugin.reports.bench.runner import run_bench

    run_bench(raster_bench(options), options, _console())


def cuda(options: Options = BenchOptions()) -> None:  # noqa: B008
    """Time gsplat beside the torch reference on a CUDA device; memory, and errors against float64."""
    from freqgs_plugin.reports.bench.cuda import cuda_bench
    from freqgs_plugin.reports.bench.runner import run_bench

    run_bench(cuda_bench(options), options, _console())


def scaling(options: Options = BenchOptions()) -> None:  # noqa: B008
    """Time numba and torch as Gaussians and pixels become more, and fit the exponents."""
    from freqgs_plugin.reports.bench.runner import run_bench
    from freqgs_plugin.reports.bench.scaling import scaling_bench

    run_bench(scaling_bench(options), options, _console())


def accuracy(load_config: Path | None = None, options: Options = BenchOptions()) -> None:  # noqa: B008
    """Measure errors beside times: of the backends against float64, and of each approximation against the exact sum.

    Args:
        load_config: config.yml of a trained run, of which a held-out view is measured as well.
        options: where to write, and how to measure.
    """
    from freqgs_plugin.reports.bench.accuracy import accuracy_bench
    from freqgs_plugin.reports.bench.runner import run_bench
    from freqgs_plugin.reports.bench.trained import load, trained_workload

    trained = None if load_config is None else trained_workload(load(load_config))
    arguments = [] if load_config is None else ["--load-config", "RUN/config.yml"]
    run_bench(accuracy_bench(options, trained), options, _console(), *arguments)


def step(data: Path, steps: int = 1200, options: Options = BenchOptions()) -> None:  # noqa: B008
    """Train lapsplat for a while, on the CPU, and tell which part of a step takes how long.

    Args:
        data: folder with a COLMAP model and its images, or with a transforms.json.
        steps: length of the run; all step constants scale with it, so every stage comes.
        options: where to write, and how to measure.
    """
    from freqgs_plugin.reports.bench.runner import run_bench
    from freqgs_plugin.reports.bench.step import step_bench

    arguments = ["--data", data.resolve().name, "--steps", str(steps)]
    run_bench(step_bench(options, data, steps), options, _console(), *arguments)


def savings(load_config: Path, options: Options = BenchOptions()) -> None:  # noqa: B008
    """Measure what leaving out saves, each with and without: rows, bands, prefixes, transforms, gradients.

    Args:
        load_config: config.yml of a trained run.
        options: where to write, and how to measure.
    """
    from freqgs_plugin.reports.bench.runner import check_options, run_bench
    from freqgs_plugin.reports.bench.savings import TABLES, savings_bench
    from freqgs_plugin.reports.bench.savings_cases import subject_of
    from freqgs_plugin.reports.bench.trained import load, views_of

    check_options(options, TABLES)
    run = load(load_config)
    bench = savings_bench(options, subject_of(run, views_of(run)[0]))
    run_bench(bench, options, _console(), "--load-config", "RUN/config.yml")


def apps(load_config: Path, options: Options = BenchOptions()) -> None:  # noqa: B008
    """Measure foveation by image size, filters, and an index of the base against one of everything: time and error.

    Args:
        load_config: config.yml of a trained run of several levels.
        options: where to write, and how to measure.
    """
    from freqgs_plugin.reports.bench.apps import TABLES, app_subject, apps_bench
    from freqgs_plugin.reports.bench.runner import check_options, run_bench
    from freqgs_plugin.reports.bench.trained import load, views_of

    check_options(options, TABLES)
    run = load(load_config)
    bench = apps_bench(options, app_subject(run, views_of(run)))
    run_bench(bench, options, _console(), "--load-config", "RUN/config.yml")


def stream(
    load_config: tuple[Path, ...],
    names: tuple[str, ...] = (),
    options: Options = BenchOptions(),  # noqa: B008
) -> None:
    """Measure streams of trained runs: error against bytes, pictures by bytes received, seconds on slow lines.

    Args:
        load_config: config.yml of one or more trained runs.
        names: what the runs are called in the tables; otherwise as their experiments.
        options: where to write, and how to measure.
    """
    from freqgs_plugin.reports.bench.runner import check_options, run_bench
    from freqgs_plugin.reports.bench.stream import TABLES, stream_bench
    from freqgs_plugin.reports.bench.stream_measure import subject_of_run

    if names and len(names) != len(load_config):
        raise BenchError(f"--names holds {len(names)} names for {len(load_config)} runs; give one for each, or none.")
    check_options(options, TABLES)
    given = names or (None,) * len(load_config)
    subjects = [subject_of_run(path, name) for path, name in zip(load_config, given, strict=True)]
    arguments = ["--load-config", *["RUN/config.yml"] * len(load_config), *(["--names", *names] if names else [])]
    run_bench(stream_bench(options, subjects), options, _console(), *arguments)


def _console() -> Any:
    """Tables are not folded to the 80 columns that a file or a pipe would have."""
    from rich.console import Console

    return Console() if sys.stdout.isatty() else Console(width=200)


BENCHES = {
    "raster": raster,
    "cuda": cuda,
    "scaling": scaling,
    "accuracy": accuracy,
    "step": step,
    "savings": savings,
    "apps": apps,
    "stream": stream,
}
"""name on the command line -> function"""
