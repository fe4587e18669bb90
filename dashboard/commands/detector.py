"""A detector as it is written on the command line."""

from __future__ import annotations

from deploy.check import BadSpecError

DETECTOR_FORM = "SCHEME[,NAME=VALUE...]"


def detector_fields(text: str) -> dict[str, str]:
    """The fields of :class:`DetectorSpec` in ``text``; a model is a file's name yet.

    :raises BadSpecError: if it has not the form.
    """
    scheme, *settings = text.split(",")
    fields = {"scheme": scheme}
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or name in fields:
            what = "twice the same name" if equals else "no NAME=VALUE"
            message = f"--detector: {what} in {setting!r}; expected {DETECTOR_FORM}"
            raise BadSpecError(message)
        fields[name] = value
    return fields
