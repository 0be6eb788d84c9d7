"""The filter of system calls allows what stands in its table, and nothing else."""

from __future__ import annotations

import errno
import re
from pathlib import Path

import pytest

from worker import system_calls
from worker.system_calls import ALLOWED, ARCHITECTURES, BY_ARGUMENT, CLONE, Instruction, call_filter

HEADERS = {
    "x86_64": Path("/usr/include/x86_64-linux-gnu/asm/unistd_64.h"),
    "aarch64": Path("/usr/include/asm-generic/unistd.h"),
}
MACHINES = list(ARCHITECTURES)


def _answer(program: list[Instruction], architecture: int, number: int, *arguments: int) -> int:
    """Return a filter's answer to a call, as a kernel finds it."""
    data = {0: number, 4: architecture}
    data |= {16 + 8 * place: value & 0xFFFFFFFF for place, value in enumerate(arguments)}
    at = value = 0
    while True:
        code, if_true, if_false, operand = program[at]
        at += 1
        if code == system_calls.RETURN:
            return operand
        if code == system_calls.LOAD:
            value = data.get(operand, 0)
            continue
        holds = {
            system_calls.JUMP_IF_EQUAL: value == operand,
            system_calls.JUMP_IF_AT_LEAST: value >= operand,
            system_calls.JUMP_IF_ANY: bool(value & operand),
        }
        at += if_true if holds[code] else if_false


@pytest.mark.parametrize("machine", MACHINES)
def test_every_other_call_is_refused(machine: str) -> None:
    column = MACHINES.index(machine)
    architecture = ARCHITECTURES[machine]
    program = call_filter(machine)
    allow = 0x7FFF0000
    eperm = 0x50000 | errno.EPERM
    enosys = 0x50000 | errno.ENOSYS
    allowed = {numbers[column] for numbers in ALLOWED.values()}
    judged = {rule.numbers[column]: rule for rule in BY_ARGUMENT.values()}
    clone = CLONE[column]
    assert clone is not None
    for number in (*range(1000), 1 << 30, (1 << 30) + 1, 0xFFFFFFFF):
        if number in allowed:
            assert _answer(program, architecture, number) == allow
        elif number in judged:
            rule = judged[number]
            arguments = [0] * 6
            for value in (*range(1100), *rule.values, 0x5412, 0x80000000):
                arguments[rule.place] = value
                expected = allow if value in rule.values else eperm
                assert _answer(program, architecture, number, *arguments) == expected
        elif number != clone:
            expected = enosys if number >= 424 else eperm
            assert _answer(program, architecture, number) == expected
        assert _answer(program, 0x40000003, number) == eperm  # the same number, in 32 bits
    threads = 0x3D0F00
    namespace = 0x10000011
    assert _answer(program, architecture, clone, threads) == allow
    assert _answer(program, architecture, clone, namespace) == eperm


@pytest.mark.parametrize("machine", MACHINES)
def test_the_numbers_are_the_kernels(machine: str) -> None:
    if not HEADERS[machine].exists():
        pytest.skip("no kernel headers here")
    text = HEADERS[machine].read_text()
    found = dict(re.findall(r"#define __NR(?:3264)?_(\w+)\s+(\d+)", text))
    if machine == "aarch64":  # which names these by their older forms
        found |= {"newfstatat": found["fstatat"], "arch_prctl": "None"}
    rules = {name: rule.numbers for name, rule in BY_ARGUMENT.items()}
    for name, numbers in {**ALLOWED, **rules, "clone": CLONE}.items():
        number = numbers[MACHINES.index(machine)]
        assert number is None or str(number) == found[name], name
