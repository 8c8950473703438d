"""The commands of `freqgs bench`. Heavy imports happen inside of them."""

from typing import Annotated

import tyro

from freqgs_plugin.reports.bench.options import BenchOptions

Options = Annotated[BenchOptions, tyro.conf.arg(name="")]


def raster(options: Options = BenchOptions()) -> None:  # noqa: B008
    """Time every backend, and measure its memory; all prefixes in one pass; less detail against everything."""
    from rich.console import Console

    from freqgs_plugin.reports.bench.raster import raster_bench
    from freqgs_plugin.reports.bench.runner import run_bench

    run_bench(raster_bench(options), options, Console())


def scaling(options: Options = BenchOptions()) -> None:  # noqa: B008
    """Time numba and torch as Gaussians and pixels become more, and fit the exponents."""
    from rich.console import Console

    from freqgs_plugin.reports.bench.runner import run_bench
    from freqgs_plugin.reports.bench.scaling import scaling_bench

    run_bench(scaling_bench(options), options, Console())


BENCHES = {"raster": raster, "scaling": scaling}
"""name on the command line -> function"""
