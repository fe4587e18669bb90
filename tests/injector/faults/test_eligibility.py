"""What a fault may strike is what the instruction has of the kind that it asks for."""

from typing import Any

import pytest

from injector.faults.eligibility import is_eligible
from injector.isa.x86_64_decoder import decode
from services.models.faults.specification import FaultSpec

pytestmark = pytest.mark.unit

CODES = {
    "add rax,rcx": "4801c8",
    "jne": "75f8",
    "mulsd xmm0,xmm1": "f20f59c1",
    "mov rax,[rbx]": "488b03",
    "mov [rbx],rax": "488903",
    "nop": "90",
    "syscall": "0f05",
    "movaps xmm0,xmm1": "0f28c1",
    "kmovw k1,eax": "c5f892c8",
}


@pytest.mark.parametrize(
    ("fields", "eligible"),
    [
        ({}, set(CODES) - {"nop", "syscall"}),
        ({"register_class": "vector"}, {"mulsd xmm0,xmm1", "movaps xmm0,xmm1"}),
        ({"register_class": "mask"}, {"kmovw k1,eax"}),
        ({"register_class": "flags", "operand": "source"}, {"jne"}),
        ({"register_class": "flags", "operand": "destination"}, {"add rax,rcx"}),
        ({"field": "exponent"}, {"mulsd xmm0,xmm1"}),
        ({"model": "memory"}, {"mov rax,[rbx]", "mov [rbx],rax"}),
        ({"model": "memory", "operand": "destination"}, {"mov [rbx],rax"}),
        ({"model": "opcode"}, set(CODES) - {"syscall"}),
        ({"bit_numbers": [40, 41]}, set(CODES) - {"jne", "nop", "syscall", "kmovw k1,eax"}),
        ({"bit_numbers": [100]}, {"movaps xmm0,xmm1"}),
        ({"model": "opcode", "bits": 17}, set(CODES) - {"syscall", "jne", "nop"}),
        ({"registers": ["rip"]}, set(CODES) - {"syscall"}),
        ({"registers": ["al"], "bits": 9}, set()),
        ({"mask": "byte"}, set(CODES) - {"nop", "syscall"}),
        ({"mask": "word", "model": "memory"}, {"mov rax,[rbx]", "mov [rbx],rax"}),
        ({"mask": "uniform", "field": "exponent"}, {"mulsd xmm0,xmm1"}),
        ({"mask": "histogram", "histogram": {"bits": {1: 0.5, 65: 0.5}}}, {"movaps xmm0,xmm1"}),
        (
            {"mask": "histogram", "histogram": {"positions": {2: 0.5, 40: 0.5}}},
            set(CODES) - {"jne", "nop", "syscall", "kmovw k1,eax"},
        ),
        (
            {"mask": "histogram", "histogram": {"masks": {"0x5": 0.5, hex(1 << 70): 0.5}}},
            {"movaps xmm0,xmm1"},
        ),
        (
            {"mask": "histogram", "histogram": {"bits": {20: 1.0}}, "model": "opcode"},
            {"add rax,rcx", "mulsd xmm0,xmm1", "mov rax,[rbx]", "mov [rbx],rax", "movaps xmm0,xmm1"}
            | {"kmovw k1,eax"},
        ),
    ],
)
def test_an_instruction_is_eligible_by_its_operands(fields: dict[str, Any], eligible: set[str]) -> None:
    fault = FaultSpec.model_validate({"target": "pid", **fields})
    found = {name for name, code in CODES.items() if is_eligible(fault, decode(bytes.fromhex(code), 0x1000))}
    assert found == eligible
