"""The papers' claims: what each says, how it is measured here, and when it holds."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from freqgs_plugin.reports.experiments import ablation, budget, curve, pops
from freqgs_plugin.reports.experiments.claims_measures import figures, foveated, speeds
from freqgs_plugin.reports.experiments.lab import Lab
from freqgs_plugin.reports.experiments.options import TrialOptions
from freqgs_plugin.reports.experiments.section import Results
from freqgs_plugin.reports.experiments.seeds import mean, shown
from freqgs_plugin.reports.experiments.training import ABLATION_SCALE, Training, Trial
from freqgs_plugin.training.presets import Value

HALF = 0.5
"""a claim holds if at least this part of the paper's figure is found"""
EQUAL = 0.1
"""dB within which two PSNRs count as equal"""


@dataclass(frozen=True)
class Verdict:
    """What was found in one scene."""

    found: str
    holds: bool | None
    """None: it cannot be measured here, and `found` says why"""


@dataclass(frozen=True)
class Claim:
    """One row of the table."""

    name: str
    """A: Frequency-Aware Gaussian Splatting Decomposition, B: CLoD-GS"""
    text: str
    paper: str
    """its figure"""
    condition: str
    """when it holds here"""
    measure: Callable[[Lab, Trial, TrialOptions], dict[str, Any]]
    judge: Callable[[str, Results], Verdict]


PAPER = "lapsplat-paper"
VARIANTS: Mapping[str, tuple[str, Mapping[str, Value]]] = {
    "lapsplat": ("lapsplat", {}),
    "small base": ("lapsplat", {"base_share": 0.2}),
    "paper": (PAPER, {}),
    "no DFT": (PAPER, {"dft_weight": 0.0}),
    "no lower levels": (PAPER, {"lower_level_weight": 0.0}),
    "unsigned": (PAPER, {"signed_residuals": False}),
    "clodsplat-paper": ("clodsplat-paper", {}),
}
"""name -> method and options; `plain` and `clodsplat` are those of `freqgs experiment clod`"""
RUNS = ("plain", *VARIANTS, "clodsplat")
"""every run of the table"""


def training_of(trial: Trial, name: str) -> Training:
    """The run of that name in `RUNS`."""
    if name == "plain":
        return trial.plain()
    if name == "clodsplat":
        return trial.clod()
    method, options = VARIANTS[name]
    return Training(trial.scene, method, trial.steps, trial.seed, options)


def of_runs(*names: str) -> Callable[[Lab, Trial, TrialOptions], dict[str, Any]]:
    """Measures the figures of each run."""

    def measure(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
        trainings = {name: training_of(trial, name) for name in names}
        return {
            name: lab.step("claims-figures", [training], {}, lambda t=training: figures(lab.run(t)))
            for name, training in trainings.items()
        }

    return measure


def _with_speeds(*names: str) -> Callable[[Lab, Trial, TrialOptions], dict[str, Any]]:
    def measure(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
        trainings = [training_of(trial, name) for name in names]
        runs = of_runs(*names)(lab, trial, options)
        times = lab.step(
            "claims-speeds",
            trainings,
            {"names": list(names)},
            lambda: speeds({name: lab.load(t, lab.config_path(t)) for name, t in zip(names, trainings, strict=True)}),
        )
        return {"runs": runs, "times": times}

    return measure


def _foveation(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
    training = training_of(trial, "lapsplat")
    return lab.step("claims-foveation", [training], {"ways": ["plain", "smaller"]}, lambda: foveated(lab.run(training)))


def _gain(results: Results, name: str, other: str) -> str:
    return shown(results, lambda r: r[name]["psnr"] - r[other]["psnr"], "+.2f") + " dB"


def _needing(levels: int, judge: Callable[[str, Results], Verdict]) -> Callable[[str, Results], Verdict]:
    """`judge`, unless the photographs were too small for so many levels."""

    def judged(scene: str, results: Results) -> Verdict:
        least = min(len(run["scales"]) for result in results for run in result.values())
        if least >= levels:
            return judge(scene, results)
        return Verdict(f"it needs {levels} levels, and these photographs are large enough for {least}", None)

    return judged


def _better(scene: str, results: Results) -> Verdict:
    paper = mean(results, lambda r: r["paper"]["psnr"] - r["plain"]["psnr"])
    return Verdict(
        f"{_gain(results, 'paper', 'plain')} with the paper's settings, "
        f"{_gain(results, 'lapsplat', 'plain')} with ours",
        paper >= HALF * 1.9,
    )


def _fewer(scene: str, results: Results) -> Verdict:
    def count(name: str) -> Callable[[Any], float]:
        return lambda r: r["runs"][name]["gaussians"] / r["runs"]["plain"]["gaussians"]

    def speed(name: str) -> Callable[[Any], float]:
        return lambda r: r["times"]["plain"]["median_ms"] / r["times"][name]["median_ms"]

    words = [
        f"{shown(results, count(name))} of the Gaussians, {shown(results, speed(name))} x as fast with {whose}"
        for name, whose in (("paper", "the paper's settings"), ("lapsplat", "ours"))
    ]
    holds = mean(results, count("paper")) <= 1 - HALF * 0.7 and mean(results, speed("paper")) >= 1 + HALF * 0.8
    return Verdict("; ".join(words), holds)


def _needs_dft(scene: str, results: Results) -> Verdict:
    def added(name: str) -> Callable[[Any], float]:
        return lambda r: sum(r[name]["added"][1:])

    words = f"levels 2 and 3 change the picture by {shown(results, added('no DFT'))} grey levels without it"
    return Verdict(
        f"{words}, {shown(results, added('paper'))} with it; PSNR {_gain(results, 'no DFT', 'paper')} without it",
        mean(results, added("no DFT")) <= HALF * mean(results, added("paper")),
    )


def _needs_lower_levels(scene: str, results: Results) -> Verdict:
    lost = [(lambda r, k=k: r["no lower levels"]["prefixes"][k] - r["paper"]["prefixes"][k]) for k in (0, 1)]
    words = ", ".join(f"prefix {k + 1}: {shown(results, get, '+.2f')} dB" for k, get in enumerate(lost))
    first, second = (mean(results, get) for get in lost)
    return Verdict(words, first <= -HALF * 3.7 and second <= -HALF * 2.9)


def _unsigned(scene: str, results: Results) -> Verdict:
    def more(r: Any) -> float:
        return 100 * (r["unsigned"]["gaussians"] / r["paper"]["gaussians"] - 1)

    return Verdict(
        f"{shown(results, more, '+.0f')} % Gaussians, {_gain(results, 'unsigned', 'paper')}",
        mean(results, more) >= HALF * 100 * (515 / 409 - 1),
    )


def _smaller(scene: str, results: Results) -> Verdict:
    def falls(name: str) -> bool:
        sizes = [mean(results, lambda r, k=k: r[name]["scales"][k]) for k in range(len(results[0][name]["scales"]))]
        return all(after < before for before, after in pairwise(sizes))

    words = []
    for name, whose in (("paper", "the paper's settings"), ("lapsplat", "ours")):
        count = len(results[0][name]["scales"])
        sizes = [shown(results, lambda r, k=k, n=name: r[n]["scales"][k], ".4f") for k in range(count)]
        words.append(f"{' / '.join(sizes)} with {whose}")
    return Verdict("; ".join(words), falls("paper"))


def _foveation_pays(scene: str, results: Results) -> Verdict:
    def faster(way: str) -> Callable[[Any], float | None]:
        return lambda r: None if r[way] is None else r[way]["faster"]

    lost = shown(results, lambda r: None if r["plain"] is None else r["plain"]["lost_inside"])
    return Verdict(
        f"{shown(results, faster('plain'))} x as fast, {lost} dB lost inside; "
        f"{shown(results, faster('smaller'))} x where fewer pixels are drawn outside, too (ours); with our settings",
        mean(results, faster("plain")) >= 1 + HALF * 0.4,
    )


def _as_good_with_fewer(scene: str, results: Results) -> Verdict:
    def share(name: str) -> Callable[[Any], float]:
        return lambda r: r[name]["gaussians"] / r["plain"]["gaussians"]

    words = [
        f"{_gain(results, name, 'plain')} with {shown(results, share(name))} of the Gaussians with {whose}"
        for name, whose in (("clodsplat-paper", "the paper's settings"), ("clodsplat", "ours"))
    ]
    gain = mean(results, lambda r: r["clodsplat-paper"]["psnr"] - r["plain"]["psnr"])
    return Verdict("; ".join(words), gain >= -EQUAL and mean(results, share("clodsplat-paper")) <= 1 - HALF * 0.38)


def _falls_gracefully(scene: str, results: Results) -> Verdict:
    """Judged against the paper's formula alone, at every share."""

    def margins(name: str) -> list[float]:
        rows = range(len(results[0]["shares"]))
        return [mean(results, lambda r, i=i: r["shares"][i][name]["psnr"] - _by_formula(r["shares"][i])) for i in rows]

    free = margins("s_v")
    at_quarter = free[budget.SHARES.index(budget.GAIN_AT)]
    return Verdict(f"least {min(free):+.2f} dB above it, {at_quarter:+.2f} dB at a quarter; with ours", min(free) > 0)


def _by_formula(row: dict[str, Any]) -> float:
    return max(row["shared"]["psnr"], row["chosen"]["psnr"])


def _no_jump(scene: str, results: Results) -> Verdict:
    goals = pops.goals(scene, results)[:2]
    words = "; ".join(goal.figures for goal in goals)
    return Verdict(
        f"largest change by median and by a switch of models: {words}; with ours", all(g.reached for g in goals)
    )


_FULL = ablation.name_of(True, "ste")
_WITHOUT = {"w_s": ablation.name_of(False, "ste"), "L_reg": ablation.name_of(True, "off")}


def _parts_matter(scene: str, results: Results) -> Verdict:
    """Each part alone left out of the full method, at s_v = 5: more Gaussians at no better PSNR, or a lower PSNR."""

    def change(name: str, figure: str) -> float:
        return mean(results, lambda r: r["ablation"][name]["reduced"][figure] - r["ablation"][_FULL]["reduced"][figure])

    words, matter = [], []
    for part, name in _WITHOUT.items():
        lost, more = change(name, "psnr"), change(name, "drawn")
        count = mean(results, lambda r: r["ablation"][_FULL]["reduced"]["drawn"])
        words.append(f"without {part} {lost:+.2f} dB with {100 * more / count:+.0f} % Gaussians")
        matter.append(lost < -EQUAL or more > 0.05 * count)

    def multi(name: str, figure: str) -> float:
        return mean(results, lambda r: next(row for row in r["curve"][name] if row["scale"] == ABLATION_SCALE)[figure])

    trained = f"{ABLATION_SCALE:g}"
    lost = multi("1", "psnr") - multi(trained, "psnr")
    more = multi("1", "drawn") / multi(trained, "drawn") - 1
    words.append(f"without other scales {lost:+.2f} dB with {100 * more:+.0f} %")
    matter.append(lost < -EQUAL or more > 0.05)
    return Verdict(f"{', '.join(words)}; with ours and s_max {trained}", all(matter))


def _parts(lab: Lab, trial: Trial, options: TrialOptions) -> dict[str, Any]:
    scales = curve.by_largest_scale(lab, trial, (1.0, ABLATION_SCALE))
    return {"ablation": ablation.of_cells(lab, trial, (_FULL, *_WITHOUT.values())), "curve": scales}


CLAIMS: tuple[Claim, ...] = (
    Claim(
        "A-a",
        "PSNR above the base method",
        "+1.9 dB",
        "at least half of it",
        of_runs("plain", "paper", "lapsplat"),
        _better,
    ),
    Claim(
        "A-b",
        "fewer Gaussians, faster",
        "0.30 of the count, 1.8 x",
        "at least half of both savings",
        _with_speeds("plain", "paper", "lapsplat"),
        _fewer,
    ),
    Claim(
        "A-c",
        "without L_DFT the higher levels hold almost nothing",
        "a picture",
        "what they add to the picture falls to less than half",
        of_runs("paper", "no DFT"),
        _needing(2, _needs_dft),
    ),
    Claim(
        "A-d",
        "without the image loss on lower levels, lower prefixes lose",
        "-3.7 dB (x4), -2.9 dB (x2)",
        "at least half of both",
        of_runs("paper", "no lower levels"),
        _needing(3, _needs_lower_levels),
    ),
    Claim(
        "A-e",
        "unsigned colours need more Gaussians",
        "+26 %, +0.2 dB",
        "at least half of +26 %",
        of_runs("paper", "unsigned"),
        _unsigned,
    ),
    Claim(
        "A-f",
        "the mean scale falls with the level",
        "a figure",
        "from each level to the next",
        of_runs("paper", "lapsplat"),
        _needing(2, _smaller),
    ),
    Claim(
        "A-g",
        "foveation at 4K",
        "1.4 x",
        "at least half of the gain, at most 0.2 dB lost inside",
        _foveation,
        _foveation_pays,
    ),
    Claim(
        "B-a",
        "as good with fewer Gaussians",
        "+0.14 dB with 0.62",
        "at most 0.1 dB lost, and half of the saving",
        of_runs("plain", "clodsplat-paper", "clodsplat"),
        _as_good_with_fewer,
    ),
    Claim(
        "B-b",
        "quality falls gracefully; better than cutting a plain model by the same formula",
        "a figure",
        "above it at every share from 100 to 10 %",
        budget.measure,
        _falls_gracefully,
    ),
    Claim(
        "B-c",
        "no visible jump along s_v",
        "a figure",
        "largest change at most 3 x the median, and a tenth of a switch",
        pops.measure,
        _no_jump,
    ),
    Claim(
        "B-d",
        "w_s, L_reg and other scales in training each matter",
        "a table",
        "at s_v 5 each costs over 0.1 dB, or over 5 % more Gaussians, where it is left out",
        _parts,
        _parts_matter,
    ),
)
