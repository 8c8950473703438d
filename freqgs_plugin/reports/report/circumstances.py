"""When, where, with what and from which seeds: it stands in every file of a report."""

from collections.abc import Mapping
from typing import Any

from freqgs_plugin.reports.report.tables import seeds


def sentence(record: Mapping[str, Any]) -> str:
    """All of it, Markdown."""
    threads = record["hardware"]["threads"]
    views = record["views"]
    sizes = ", ".join(f"{width}x{height}" for width, height in views["sizes"][:3])
    parts = [
        f"{record['date']}, commit {record['commit']}",
        f"{_machine(record)}, {threads} thread{'s' if threads > 1 else ''} used",
        ", ".join(f"{name} {found}" for name, found in record["versions"].items() if found),
        f"seeds: {_seeds(record)}",
        f"load before the start {record['load']}",
        f"{views['measured']} of {views['held_out']} held-out views measured ({sizes} px), {views['timed']} of them "
        f"timed in {record['rounds']} rounds",
        f"LPIPS {record['lpips']}",
        f"`{record['command']}`",
    ]
    return "; ".join(parts) + "."


def short(record: Mapping[str, Any]) -> str:
    """The same for the foot of a plot."""
    versions = ", ".join(f"{name} {record['versions'][name]}" for name in ("torch", "numba", "gsplat"))
    return (
        f"{record['date'][:10]}, commit {record['commit']}, {_machine(record)}, "
        f"{record['hardware']['threads']} thread(s), {versions}, seeds: {_seeds(record)}"
    )


def metadata(record: Mapping[str, Any]) -> dict[str, str]:
    """For the text chunks of a PNG file."""
    return {"Software": "freqgs report", "Creation Time": record["date"], "Description": sentence(record)}


def _machine(record: Mapping[str, Any]) -> str:
    hardware = record["hardware"]
    return f"{hardware['processor']}, {hardware['cores']} cores, {hardware['gpu'] or 'no GPU'}"


def _seeds(record: Mapping[str, Any]) -> str:
    each = [seeds(run) for run in record["runs"]]
    if len(set(each)) == 1:
        return f"{each[0]}{' each' if len(each) > 1 else ''}"
    return ", ".join(f"{run['name']} {seed}" for run, seed in zip(record["runs"], each, strict=True))
