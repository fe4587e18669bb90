"""Bodies that are nearly right: presets and flights with one or two values deep inside replaced by others."""

import copy
import json
import random
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from dashboard.campaigns.presets import presets
from dashboard.campaigns.spec import load_campaign
from dashboard.campaigns.store.store import Store
from services.models.faults.specification import FaultSpec
from services.models.mission import MissionSpec
from tests.dashboard.api.asking import CAMPAIGNS, ask, make
from tests.dashboard.api.test_contract import SPEC
from tests.dashboard.campaigns.store.test_store import flown

JSON = {"Content-Type": "application/json"}

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63, -(2**64), 10**400, 0.0, -0.0, 1e-320, 1e308, -1e308),
    *(
        float("nan"),
        float("inf"),
        -float("inf"),
        "",
        " ",
        "0",
        "nan",
        "x" * 100_000,
        "\0",
        "\ud800",
        "\u202e",
    ),
    *("../../etc/passwd", "/dev/zero", "a/" * 3000, "http://127.0.0.1:1/", "{}", "$(id)", "%s%n", "🛸" * 500),
    *([], {}, [None], [[]], {"": None}, {"kind": "?"}, [0] * 10_000, [{"name": "a"}] * 300),
)
"""What a field may be given instead; JSON has no nan, but many writers have."""

RAW = (
    *(b"", b"{", b"null", b"[]", b"0", b'"x"', b"\xff\xfe", b'{"spec":', b"[" * 100_000, b'{"a":' * 50_000),
    *(b'{"spec": {}, "spec": []}', b"\xef\xbb\xbf{}", b"1e999999999", b"9" * 200_000, b'"\\ud800"'),
)


@pytest.fixture
def app(tmp_path: Path) -> Iterator[FastAPI]:
    """One for each test: of one service, only so many requests are worked on in a row."""
    with closing(Store(tmp_path)) as store:
        flown(store, store.create(SPEC), 1)
        yield make(store)


def places(document: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where in a document there is a value."""
    if path:
        yield path
    inside = document.items() if isinstance(document, dict) else ()
    for key, value in enumerate(document) if isinstance(document, list) else inside:
        yield from places(value, (*path, key))


def fuzzed(document: Any, draw: random.Random) -> Any:
    """A copy with one or two values replaced, or a key renamed."""
    changed = copy.deepcopy(document)
    for _ in range(draw.randint(1, 2)):
        *outer, last = draw.choice(list(places(changed)))
        holder = changed
        for key in outer:
            holder = holder[key]
        if isinstance(holder, dict) and draw.random() < 0.15:
            holder[draw.choice(("", "x" * 1000, "__class__", "\0", "$ref"))] = holder.pop(last)
        else:
            holder[last] = copy.deepcopy(draw.choice(VALUES))
    return changed


def bodies(seed: int, count: int) -> Iterator[tuple[str, bytes]]:
    """Path and body, the same each time."""
    draw = random.Random(seed)  # noqa: S311 - no secret
    campaigns = [load_campaign(one.name).model_dump(mode="json") for one in presets()]
    mission = MissionSpec(fault=FaultSpec(target="pid")).model_dump(mode="json")
    fault = FaultSpec(level="source", target="command.vx").model_dump(mode="json")
    paths = (CAMPAIGNS, f"{CAMPAIGNS}/forecast", "/api/v1/flights", "/api/v1/flights/known-1/faults")
    for _ in range(count - len(RAW)):
        path = draw.choice(paths)
        if path.endswith("faults"):
            whole: Any = {"fault": fault}
        elif path.endswith("flights"):
            whole = {"mission": mission}
        else:
            whole = {"spec": draw.choice(campaigns)}
        yield path, json.dumps(fuzzed(whole, draw)).encode()
    yield from ((draw.choice(paths), raw) for raw in RAW)


@pytest.mark.parametrize(
    ("seed", "count"), [(0, 50), *(pytest.param(seed, 200, marks=pytest.mark.soak) for seed in range(1, 6))]
)
def test_what_is_nearly_right_is_taken_or_refused_and_never_fails(
    app: FastAPI, seed: int, count: int
) -> None:
    told: dict[int, int] = {}
    for path, body in bodies(seed, count):
        answer = ask(app, path, "POST", content=body, headers=JSON)
        assert answer.status_code < 500, f"{path}: {body[:500]!r}: {answer.text[:500]}"
        if answer.status_code >= 400:
            assert answer.headers["Content-Type"] == "application/problem+json"
            assert len(answer.text) < 20_000, f"{path}: {body[:200]!r}"
        told[answer.status_code] = told.get(answer.status_code, 0) + 1
    assert 429 not in told, "all of them are looked at"
    assert told[422] > count / 2
    assert sum(told.values()) == count
    assert told.get(201, 0) > 0, "some are still right"


def test_a_name_without_end_does_not_come_back(app: FastAPI) -> None:
    spec = {"name": "x", "runs": 1, "arms": [{"name": "a"}], "mission": {"guards": ["x" * 500_000]}}
    answer = ask(app, CAMPAIGNS, "POST", json={"spec": spec})
    assert answer.status_code == 422
    assert len(answer.text) < 5000
    assert "unknown guard" in answer.json()["detail"]
    assert "known: finite" in answer.json()["detail"]


def test_a_body_says_what_it_is(app: FastAPI) -> None:
    body = json.dumps({"preset": "demo"}).encode()
    for headers in (
        {"Content-Type": "text/plain"},
        {"Content-Type": "application/x-www-form-urlencoded"},
        {**JSON, "Content-Encoding": "gzip"},
        {"Content-Type": "application/json; charset=utf-16"},
        {},
    ):
        assert 400 <= ask(app, CAMPAIGNS, "POST", content=body[:-1], headers=headers).status_code < 500
