"""The mask histogram: how many bits flip at once, and which, as somebody measured it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from services.models.base import Strict

_Probability = Annotated[float, Field(ge=0, le=1)]
_Count = Annotated[int, Field(ge=1, le=512)]
_Position = Annotated[int, Field(ge=0, lt=512)]
_Mask = Annotated[str, Field(pattern=r"^0x0*[1-9a-fA-F][0-9a-fA-F]{0,127}$")]
_ROUNDING = 1e-6


class MaskHistogram(Strict):
    """The probabilities of how many bits flip and of which, as they were measured: a TOML file's content.

    ``bits`` has those of each number of bits (left out: one bit). ``positions`` has those of each bit (left
    out: all alike); of several bits, each further one is drawn from those left, in the same proportions.
    ``masks`` has, in the place of both, those of whole masks in hexadecimal. Each table sums to 1.
    """

    bits: dict[_Count, _Probability] = Field(default={}, description="number of flipped bits: probability")
    positions: dict[_Position, _Probability] = Field(default={}, description="number of a bit: probability")
    masks: dict[_Mask, _Probability] = Field(default={}, description="mask, such as 0x81: probability")

    @field_validator("bits", "positions")
    @classmethod
    def _in_order(cls, table: dict[int, float]) -> dict[int, float]:
        """The same content draws the same, in whatever order it was written."""
        return dict(sorted(table.items()))

    @field_validator("masks")
    @classmethod
    def _masks_in_order(cls, table: dict[str, float]) -> dict[str, float]:
        return dict(sorted(table.items(), key=lambda one: (int(one[0], 16), one[0])))

    @model_validator(mode="after")
    def _refuse_nonsense(self) -> MaskHistogram:
        problem = next(self._problems(), None)
        if problem is not None:
            raise ValueError(problem)
        return self

    def _problems(self) -> Iterator[str]:
        if not (self.bits or self.positions or self.masks):
            yield "a histogram has a table bits, positions or masks"
        if self.masks and (self.bits or self.positions):
            yield "masks say how many bits and which: leave out bits and positions"
        for name, table in self._tables():
            total = math.fsum(table.values())
            if table and abs(total - 1) > _ROUNDING:
                yield f"{name} sums to {total:.9g}, not to 1: divide each by the sum"
        if self.positions and self.most_bits > len(self.named_bits):
            yield f"bits: {self.most_bits} of {len(self.named_bits)} positions cannot flip"

    def _tables(self) -> Iterator[tuple[str, Mapping[int, float] | Mapping[str, float]]]:
        yield "bits", self.bits
        yield "positions", self.positions
        yield "masks", self.masks

    @property
    def most_bits(self) -> int:
        """The largest number of bits that may flip at once."""
        of_masks = [int(mask, 16).bit_count() for mask, part in self.masks.items() if part > 0]
        return max([*of_masks, *(count for count, part in self.bits.items() if part > 0)], default=1)

    @property
    def named_bits(self) -> frozenset[int]:
        """The numbers of the bits that may flip; empty if that is any."""
        union = 0
        for mask, part in self.masks.items():
            union |= int(mask, 16) if part > 0 else 0
        by_mask = (bit for bit in range(union.bit_length()) if union >> bit & 1)
        return frozenset((*by_mask, *(position for position, part in self.positions.items() if part > 0)))
