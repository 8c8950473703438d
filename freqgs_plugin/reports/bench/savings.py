"""`freqgs bench savings`: what is left out where it is not needed, each measured with and without, on a trained run."""

from collections.abc import Sequence

from freqgs_plugin.reports.bench.options import BenchOptions
from freqgs_plugin.reports.bench.rounds import patient
from freqgs_plugin.reports.bench.runner import Bench, Measured, Tick
from freqgs_plugin.reports.bench.savings_cases import Saving, Subject, savings_of
from freqgs_plugin.reports.bench.tables import BenchTable, Row, milliseconds, number, ratio
from freqgs_plugin.reports.bench.workloads import IMAGE_SEED

TABLES = ("savings",)
PATIENCE = 20.0
"""for the rounds of one saving, seconds"""


def savings_bench(options: BenchOptions, subject: Subject) -> Bench:
    """The benchmark; one step per saving."""
    savings = savings_of(subject)

    def measure(tick: Tick) -> Measured:
        rows = []
        for saving in savings:
            tick(saving.what)
            rows.append(saving_row(saving, options))
        return Measured([saving_table(rows, subject)], {"image gradient": IMAGE_SEED})

    return Bench("savings", TABLES, len(savings), measure)


def saving_row(saving: Saving, options: BenchOptions) -> Row:
    """Times of both ways, and how far their results differ."""
    everything, left_out = saving.everything(), saving.left_out()
    size = float(everything.double().norm())
    difference = float((everything.double() - left_out.double()).norm()) / (size if size > 0 else 1.0)
    ways = {"everything": saving.everything, "left out": saving.left_out}
    times = patient(ways, options.rounds, PATIENCE)
    return {
        "what": saving.what,
        "how": saving.how,
        "used": saving.used,
        "everything": times["everything"],
        "left_out": times["left out"],
        "ratio": ratio(times["left out"], times["everything"]),
        "difference": difference,
    }


def saving_table(rows: Sequence[Row], subject: Subject) -> BenchTable:
    return BenchTable(
        "savings",
        "What is left out where it is not needed",
        rows,
        [
            ("what", lambda row: row["what"]),
            ("compared", lambda row: row["how"]),
            ("with it, ms", lambda row: milliseconds(row["everything"])),
            ("without, ms", lambda row: milliseconds(row["left_out"])),
            ("without / with", lambda row: number(row["ratio"])),
            ("difference", lambda row: number(row["difference"])),
            ("left out", lambda row: "yes" if row["used"] else "no"),
        ],
        f"{subject.size}, numba. *Difference*: norm of the results' difference over their norm. *Left out*: whether "
        "the package does leave it out.",
    )
