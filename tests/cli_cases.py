"""Lists the declared commands and their options, for tests that loop over them."""

from typing import get_args, get_type_hints

from typer.models import OptionInfo

from nma import cli


def commands(app=cli.app, path=()):
    """Yields the words of every command, for example (`library`, `encode`), with the command's function."""
    for command in app.registered_commands:
        name = command.name or command.callback.__name__.replace("_", "-")
        yield (*path, name), command.callback
    for group in app.registered_groups:
        yield from commands(group.typer_instance, (*path, group.name))


def parameters(function):
    """Yields name, type and declaration of each parameter of a command.

    The type of a parameter that is annotated as `int | None` is `int`.
    """
    for name, hint in get_type_hints(function, include_extras=True).items():
        if name == "return" or not hasattr(hint, "__metadata__"):
            continue
        kinds = [kind for kind in get_args(hint.__origin__) if kind is not type(None)] or [hint.__origin__]
        yield name, kinds[0], hint.__metadata__[0]


def numbers():
    """Yields (words of the command, option, declaration of the option) for every option that takes a number."""
    for words, function in commands():
        for name, kind, info in parameters(function):
            if kind in (int, float) and isinstance(info, OptionInfo):
                named = [word for word in info.param_decls if word.startswith("--")]
                yield words, named[0] if named else f"--{name.replace('_', '-')}", info
