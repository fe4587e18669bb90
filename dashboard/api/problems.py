"""Errors as problem details (RFC 9457): what is wrong, in which field, and the remedy."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field, ValidationError
from starlette.exceptions import HTTPException

from dashboard.api.programs import ForbiddenError
from dashboard.campaigns.commands import ConflictError
from dashboard.campaigns.store.database import StoreError, StoreFullError
from dashboard.campaigns.store.queries import UnknownCampaignError
from dashboard.campaigns.store.store import BusyError, RepeatedError
from deploy.compose.folder import StackError
from deploy.errors import BadSpecError, InfrastructureError

MEDIA_TYPE = "application/problem+json"
MOST_ERRORS = 20

LONGEST = 2000
"""Characters of what is told of one problem: who sent a name of a megabyte need not have it back."""

logger = logging.getLogger("zenfi.api")


class FieldProblem(BaseModel):
    """What is wrong with one field."""

    field: str = Field(examples=["spec.runs"])
    message: str = Field(examples=["Input should be greater than or equal to 1"])


class Problem(BaseModel):
    """Details of an error, as RFC 9457 defines them."""

    type: str = "about:blank"
    title: str = Field(examples=["Unprocessable Content"])
    status: int = Field(examples=[422])
    detail: str = Field(examples=["spec.runs: Input should be greater than or equal to 1"])
    errors: list[FieldProblem] = []


class NotFoundError(Exception):
    """The resource that the path names does not exist."""


class NotReadyError(Exception):
    """The service cannot take requests now: it starts or ends."""


_STATUS: dict[type[Exception], int] = {
    ForbiddenError: 403,
    NotFoundError: 404,
    UnknownCampaignError: 404,
    ConflictError: 409,
    BusyError: 409,
    RepeatedError: 422,
    BadSpecError: 422,
    NotReadyError: 503,
    StoreError: 503,
    StoreFullError: 507,
    StackError: 500,
    InfrastructureError: 500,
}


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The ``responses`` of a path that may answer with these problems."""
    return {status: {"model": Problem, "description": HTTPStatus(status).phrase} for status in statuses}


def answer(
    status: int, detail: str, errors: Sequence[FieldProblem] = (), headers: Mapping[str, str] | None = None
) -> JSONResponse:
    """A response that tells a problem."""
    title = HTTPStatus(status).phrase
    told = [one.model_copy(update={"message": _short(one.message)}) for one in errors]
    problem = Problem(title=title, status=status, detail=_short(detail), errors=told)
    return JSONResponse(problem.model_dump(), status, headers, MEDIA_TYPE)


def _short(text: str) -> str:
    """Beginning and end, where problem and remedy are."""
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"


def install(app: FastAPI) -> None:
    """Have ``app`` tell all its errors as problems."""
    for kind, status in _STATUS.items():
        app.add_exception_handler(kind, _telling(status))
    app.add_exception_handler(RequestValidationError, _invalid)
    app.add_exception_handler(ValidationError, _invalid)
    app.add_exception_handler(HTTPException, _refused)
    app.add_exception_handler(Exception, _failed)


def _telling(status: int) -> Any:
    def handle(_: Request, error: Exception) -> JSONResponse:
        return answer(status, str(error))

    return handle


def _invalid(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError | ValidationError)  # noqa: S101 - registered for these
    told = [_field(one) for one in error.errors()]
    return answer(422, f"{told[0].field}: {told[0].message}", told[:MOST_ERRORS])


def _field(error: Any) -> FieldProblem:
    # In which part of the request it is, and which form of a union, goes without saying.
    parts = [str(part) for part in error["loc"] if part not in ("body", "query", "path", "definition")]
    return FieldProblem(
        field=".".join(parts) or "body", message=str(error["msg"]).removeprefix("Value error, ")
    )


def _refused(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)  # noqa: S101 - registered for these
    headers = error.headers
    if error.status_code == 405 and (methods := _methods(request.app.openapi()["paths"], request.url.path)):
        headers = {"Allow": ", ".join(methods)}  # Starlette's names those of one of the path's routes
    return answer(error.status_code, str(error.detail), headers=headers)


def _methods(paths: Mapping[str, Mapping[str, Any]], asked: str) -> list[str]:
    """All methods that the document has for a path; of several templates that fit, the one that says most."""
    fitting = [template for template in paths if re.fullmatch(_as_pattern(template), asked)]
    closest = min(fitting, key=lambda template: template.count("{"), default=None)
    return sorted(method.upper() for method in paths.get(closest or "", ()))


def _as_pattern(template: str) -> str:
    rest = re.escape(template).replace(re.escape("{path}"), ".+")
    return re.sub(r"\\\{\w+\\\}", "[^/]+", rest)


def _failed(request: Request, error: Exception) -> JSONResponse:
    logger.error("%s %s failed", request.method, request.url.path, exc_info=error)
    return answer(500, "we failed: the service's log says why")
