"""The service does what its OpenAPI document says, whatever it is asked."""

import json
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import schemathesis
from fastapi import FastAPI
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from hypothesis.stateful import run_state_machine_as_test
from schemathesis import GenerationMode
from schemathesis.checks import load_all_checks
from schemathesis.core.errors import InvalidSchema

from dashboard.campaigns.spec import Arm, CampaignSpec
from dashboard.campaigns.store.store import Store
from services.models.faults.specification import FaultSpec
from tests.dashboard.api.asking import CAMPAIGNS, ask, make
from tests.dashboard.campaigns.store.test_store import flown

SPEC = CampaignSpec(name="known", runs=2, arms=(Arm(name="a"), Arm(name="b", fault=FaultSpec(target="pid"))))
NOT_KEPT = {
    # A schema cannot say which names there are and what goes together: that is refused with 422 and a line.
    "positive_data_acceptance",
    # On loopback who asks is known by the connection, not by anything that is sent.
    "ignored_auth",
    "object_level_authorization",
}
EXAMPLES = 15
SEEDS = range(10)
load_all_checks()
CHECKS = [
    schemathesis.checks.CHECKS.get_one(name)
    for name in schemathesis.checks.CHECKS.get_all_names()
    if name not in NOT_KEPT
]
UNREADY = [check for check in CHECKS if check.__name__ != "not_a_server_error"]
"""The streams of this service end because it has ended, so it is not ready either: 503."""


def known(folder: Path) -> Store:
    """A store with one campaign."""
    store = Store(folder)
    flown(store, store.create(SPEC), 1)
    (folder / "artefacts" / "known-1").mkdir()
    (folder / "artefacts" / "known-1" / "worker-0.log").write_text("said")
    return store


@pytest.fixture(scope="module")
def app(tmp_path_factory: pytest.TempPathFactory) -> Iterator[FastAPI]:
    with closing(known(tmp_path_factory.mktemp("contract"))) as store:
        yield make(store)


@pytest.fixture(scope="module")
def document(app: FastAPI) -> Any:
    return schemathesis.openapi.from_asgi("/api/v1/openapi.json", app, headers={"Host": "localhost"})


class FreshService:
    """An ASGI application that can be begun anew: what requests find follows from those before alone."""

    def __init__(self, folder: Path) -> None:
        self._folder, self._begun = folder, 0
        self._store: Store | None = None
        self.begin()

    def begin(self) -> None:
        self.close()
        self._begun += 1
        self._store = known(self._folder / str(self._begun))
        self._app = make(self._store)

    def close(self) -> None:
        if self._store is not None:
            self._store.close()

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        await self._app(scope, receive, send)


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[FreshService]:
    with closing(FreshService(tmp_path)) as service:
        yield service


@pytest.mark.soak
@pytest.mark.parametrize("mode", list(GenerationMode))
def test_no_answer_is_undocumented_or_a_failure(document: Any, mode: GenerationMode) -> None:
    for found in document.get_all_operations():
        operation = found.ok()

        @given(case=operation.as_strategy(generation_mode=mode))
        @settings(max_examples=EXAMPLES, derandomize=True, suppress_health_check=list(HealthCheck))
        def ask(case: Any) -> None:
            _aim(case)
            _checked(case)

        try:
            ask()
        except (Unsatisfiable, InvalidSchema):
            # Nothing in it can be wrong, or schemathesis cannot think of it: see the test below.
            assert mode == GenerationMode.NEGATIVE, operation.label


@pytest.mark.soak
@pytest.mark.parametrize("number", SEEDS)
def test_what_follows_from_an_answer_holds_in_the_next(fresh: FreshService, number: int) -> None:
    """Requests in a row: what was made is there, what was deleted is not."""
    document = schemathesis.openapi.from_asgi("/api/v1/openapi.json", fresh, headers={"Host": "localhost"})

    class Requests(document.as_state_machine()):  # type: ignore[misc]
        def setup(self) -> None:
            fresh.begin()

        def validate_response(self, response: Any, case: Any, **_: Any) -> None:
            checks = UNREADY if case.operation.path == "/ready" else CHECKS
            case.validate_response(response, checks=checks)

        def before_call(self, case: Any) -> None:
            case.headers = {**(case.headers or {}), "Host": "localhost"}
            # Nothing is to be flown.
            if case.method == "POST" and case.operation.path.endswith(("/replay", "/series", "/recording")):
                case.path_parameters = {"label": "none-0", "run": 1}

    run_state_machine_as_test(
        seed(number)(Requests),
        settings=settings(
            max_examples=EXAMPLES, stateful_step_count=6, suppress_health_check=list(HealthCheck)
        ),
    )


NONSENSE = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)
FIELDS = sorted({*CampaignSpec.model_fields, "no such field"})


@given(field=st.sampled_from(FIELDS), nonsense=NONSENSE, whole=st.booleans())
@settings(max_examples=100, derandomize=True, suppress_health_check=list(HealthCheck))
def test_a_campaign_of_nonsense_is_refused(app: FastAPI, field: str, nonsense: Any, *, whole: bool) -> None:
    spec = {**SPEC.model_dump(mode="json", exclude_unset=True), field: nonsense}
    body = json.dumps({"spec": nonsense if whole else spec})
    answer = ask(app, CAMPAIGNS, "POST", content=body, headers={"Content-Type": "application/json"})
    assert answer.status_code in (201, 422)


def _checked(case: Any) -> None:
    checks = UNREADY if case.operation.path == "/ready" else CHECKS
    case.call_and_validate(checks=checks, headers={**(case.headers or {}), "Host": "localhost"})


def _aim(case: Any) -> None:
    """Ask for what is there every other time: what is drawn hardly ever is. Nothing is to be flown."""
    parameters = case.path_parameters or {}
    flies = case.method == "POST" and case.operation.path.endswith(("/replay", "/series", "/recording"))
    if len(str(parameters.get("label", ""))) % 2 and case.method != "DELETE" and not flies:
        there = {"label": "known-1", "run": 1, "path": "worker-0.log"}
        parameters.update({name: there[name] for name in parameters})
