"""Griffe extension: Sphinx roles in docstrings, such as ``:class:`~redig.modules.DDPM```, become links of the site."""

import re
from typing import Any

import griffe

ROLE = re.compile(r":(?:class|func|meth|mod):`(~?)([\w.]+)`")


class Roles(griffe.Extension):
    """Rewrites the docstring of every object as it is loaded."""

    def on_instance(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Called for each module, class, function and attribute."""
        if obj.docstring:
            obj.docstring.value = ROLE.sub(lambda role: link(obj, *role.groups()), obj.docstring.value)


def link(obj: griffe.Object, short: str, name: str) -> str:
    """A link to ``name`` as it reads in the scope of ``obj``; plain code if the site does not document it."""
    try:
        target = obj.resolve(name)
    except griffe.NameResolutionError:
        target = name
    text = name.rpartition(".")[2] if short else name
    return f'<autoref identifier="{target}" optional><code>{text}</code></autoref>'
