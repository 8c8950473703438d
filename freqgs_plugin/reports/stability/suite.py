"""All cases of all groups."""

import importlib

from freqgs_plugin.reports.stability.case import Case, Group
from freqgs_plugin.reports.stability.cases_training import TrainingCase

GROUPS: tuple[Group, ...] = ("geometry", "compositing", "decay", "losses", "autocast", "training")


def cases_of(group: Group, quick: bool) -> list[Case | TrainingCase]:
    """The cases of a group; `quick` leaves out those that take long."""
    module = importlib.import_module(f"freqgs_plugin.reports.stability.cases_{group}")
    return [case for case in module.cases() if not (quick and case.large)]
