"""ZenFI in Python: what one fault does to a mission, and what stops it.

>>> import zenfi
>>> zenfi.fly(world="sparse", seed=7).result
'success'
>>> zenfi.Campaign("demo").run().plot()

What a name needs is loaded when it is first used, so that the import itself takes no time.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dashboard.analysis.recordings_reader import FlightRecording, open_run
    from dashboard.analysis.table import Table
    from dashboard.client import RequestRefusedError
    from deploy.errors import BadSpecError, DisturbedFlightError, InfrastructureError
    from services.models.faults.specification import FaultSpec
    from services.models.mission import MissionSpec
    from services.models.outcome import Outcome
    from zenfi import kernels, programs
    from zenfi.campaign import Campaign, FlownCampaign, StoredCampaign, campaigns, open_campaign
    from zenfi.injection import inject
    from zenfi.missions import fly, replay
    from zenfi.service import ConnectedService, connect

_FROM = {
    "BadSpecError": "deploy.errors",
    "Campaign": "zenfi.campaign",
    "ConnectedService": "zenfi.service",
    "DisturbedFlightError": "deploy.errors",
    "FaultSpec": "services.models.faults.specification",
    "FlightRecording": "dashboard.analysis.recordings_reader",
    "FlownCampaign": "zenfi.campaign",
    "InfrastructureError": "deploy.errors",
    "MissionSpec": "services.models.mission",
    "Outcome": "services.models.outcome",
    "RequestRefusedError": "dashboard.client",
    "StoredCampaign": "zenfi.campaign",
    "Table": "dashboard.analysis.table",
    "campaigns": "zenfi.campaign",
    "connect": "zenfi.service",
    "fly": "zenfi.missions",
    "inject": "zenfi.injection",
    "kernels": "zenfi",
    "open_campaign": "zenfi.campaign",
    "open_run": "dashboard.analysis.recordings_reader",
    "programs": "zenfi",
    "replay": "zenfi.missions",
}
"""The module that each public name is from; `zenfi`: it is a module itself."""

__all__ = [
    "BadSpecError",
    "Campaign",
    "ConnectedService",
    "DisturbedFlightError",
    "FaultSpec",
    "FlightRecording",
    "FlownCampaign",
    "InfrastructureError",
    "MissionSpec",
    "Outcome",
    "RequestRefusedError",
    "StoredCampaign",
    "Table",
    "campaigns",
    "connect",
    "fly",
    "inject",
    "kernels",
    "open_campaign",
    "open_run",
    "programs",
    "replay",
]


def __getattr__(name: str) -> Any:
    if name not in _FROM:
        message = f"module 'zenfi' has no attribute {name!r}"
        raise AttributeError(message)
    module = _FROM[name]
    found = import_module(f"zenfi.{name}") if module == "zenfi" else getattr(import_module(module), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__
