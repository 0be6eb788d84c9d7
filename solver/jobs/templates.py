"""The template of a job: the one that was given, else the built-in one."""

from __future__ import annotations

from typing import Any

from solver.anatomy.template import Template
from solver.jobs import Task
from solver.templates.builtin.build import builtin_template


def read_template(task: Task[Any]) -> Template:
    """Return the template that a task gives, else the built-in one."""
    given = task.inputs.get("template")
    return builtin_template() if given is None else Template.load(given)
