"""Pages from templates, the same way for every report."""

from __future__ import annotations

from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def render(template: str, **values: Any) -> str:
    """A page from one of `runs/templates`; a value that it names and nobody gave is an error, so that it says all."""
    environment = Environment(
        loader=PackageLoader("umf_ros.runs"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(template).render(**values)
