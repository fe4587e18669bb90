"""What there is to choose from: worlds, kernels, presets."""

from __future__ import annotations

from fastapi import APIRouter

from dashboard.api.problems import NotFoundError, documented
from dashboard.campaigns.presets import presets
from dashboard.campaigns.spec import CampaignSpec, load_campaign
from services.kernels import KERNELS
from services.models.base import Strict
from services.models.world import WorldDefinition
from sim.world import BadWorldError, definition, world_names

router = APIRouter(tags=["catalogue"])


class WorldName(Strict):
    """A world that is installed with zenfi."""

    name: str
    kind: str


class KernelLine(Strict):
    """A kernel into which faults can be injected."""

    name: str
    stage: str
    entry: str
    modules: tuple[str, ...]
    tolerance: tuple[float, ...]
    unit: str


class PresetInfo(Strict):
    """A campaign that comes along."""

    name: str
    about: str
    spec: CampaignSpec


@router.get("/worlds")
def list_worlds() -> list[WorldName]:
    """List the worlds that are installed with zenfi."""
    return [WorldName(name=name, kind=definition(name).kind) for name in world_names()]


@router.get("/worlds/{name}", responses=documented(404, 422))
def read_world(name: str) -> WorldDefinition:
    """Read the definition of a world."""
    try:
        return definition(name)
    except BadWorldError as error:
        raise NotFoundError(str(error)) from error


@router.get("/kernels")
def list_kernels() -> list[KernelLine]:
    """List the kernels into which faults can be injected."""
    return [
        KernelLine(**{name: getattr(kernel, name) for name in KernelLine.model_fields})
        for kernel in KERNELS.values()
    ]


@router.get("/presets", responses=documented(422))
def list_presets() -> list[PresetInfo]:
    """The campaigns that come along."""
    return [PresetInfo(**one._asdict(), spec=load_campaign(one.name)) for one in presets()]
