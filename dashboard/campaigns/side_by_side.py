"""A campaign beside its golden twins, an arm of its own, or another campaign."""

from __future__ import annotations

from dashboard.campaigns.compare import Comparison, compare, with_others, with_twins
from dashboard.campaigns.store import Campaign, Store
from deploy.check import BadSpecError


def side_by_side(
    store: Store, found: Campaign, other: Campaign | None, against: str | None
) -> list[Comparison]:
    """Each cell beside its golden twins, the cell of its name in ``other``, or that of the arm ``against``.

    :raises BadSpecError: if there is no such arm.
    """
    records = list(store.records(found))
    if other is not None:
        return compare(with_others(records, list(store.records(other)), other.label, lambda cell: cell))
    if against is None:
        return compare(with_twins(records))
    arms = [arm.name for arm in found.spec.arms]
    if against not in arms:
        message = f"--against: no arm {against!r}; the arms are {', '.join(arms)}"
        raise BadSpecError(message)
    others = [record for record in records if record.cell.arm != against]
    return compare(with_others(others, records, against, lambda cell: cell._replace(arm=against)))
