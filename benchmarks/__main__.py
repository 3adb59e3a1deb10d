"""Entry point of all benchmarks: ``python -m benchmarks NAME [options]``.

The options of a benchmark are the parameters of its function `main`: those before the `*`
are positional, the others are options with their defaults. An annotation
``Annotated[type, "help", choices]`` adds a help text and choices.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import sys
import types
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin

from skindb.errors import InputError

FOLDER = Path(__file__).parent


def summaries() -> dict[str, str]:
    """Name of each benchmark -> the first sentence of its description; nothing is imported."""
    texts = {}
    for path in sorted(FOLDER.glob("[!_]*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(x, ast.FunctionDef) and x.name == "main" for x in tree.body):
            text = ast.get_docstring(tree) or ""
            texts[path.stem] = " ".join(text.split("\n\n")[0].split())
    return texts


def add_options(parser: argparse.ArgumentParser, function: Any) -> None:
    """Add an argument for each parameter of a function."""
    for name, spec in inspect.signature(function, eval_str=True).parameters.items():
        hint = spec.annotation
        notes: Sequence[Any] = ()
        if get_origin(hint) is Annotated:
            hint, *notes = get_args(hint)
        if get_origin(hint) in (Union, types.UnionType):
            hint = get_args(hint)[0]
        settings: dict[str, Any] = {}
        for note in notes:
            settings["help" if isinstance(note, str) else "choices"] = note
        several = get_origin(hint) in (Sequence, list)
        if several:
            hint = get_args(hint)[0]
        required = spec.default is spec.empty
        if hint is bool:
            settings["action"] = "store_true"
        else:
            settings["type"] = hint
        if not required:
            settings["default"] = spec.default
        if spec.kind is spec.KEYWORD_ONLY:
            option = f"--{name.strip('_').replace('_', '-')}"
            if several:
                settings["nargs"] = "+" if required or spec.default else "*"
            parser.add_argument(option, dest=name, required=required, **settings)
        else:
            settings["nargs"] = ("+" if required else "*") if several else None
            if not required and not several:
                settings["nargs"] = "?"
            parser.add_argument(name, **settings)


def main(arguments: Sequence[str]) -> int:
    """List the benchmarks, or run one."""
    names = summaries()
    if not arguments or arguments[0] in ("-h", "--help"):
        width = max(map(len, names))
        print("python -m benchmarks NAME [options]\n")
        print("\n".join(f"{name:<{width}}  {text}" for name, text in names.items()))
        return 0
    name, *options = arguments
    if name not in names:
        print(f"there is no benchmark {name!r}; choose from {', '.join(names)}")
        return 2
    # planted data and servers that the tests use too
    sys.path.insert(0, str(FOLDER.parent / "tests"))
    module = importlib.import_module(f"benchmarks.{name}")
    parser = argparse.ArgumentParser(
        prog=f"python -m benchmarks {name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_options(parser, module.main)
    values = vars(parser.parse_args(options))
    try:
        return int(module.main(**values) or 0)
    except InputError as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
