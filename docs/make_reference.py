"""Write docs/reference.md from the docstrings of everything that `marlyap` exports.

./run python docs/make_reference.py
"""

import dataclasses
import inspect
import re
from pathlib import Path

import marlyap


PAGE = Path(__file__).parent / "reference.md"
HEAD = """# Reference

Everything that `from marlyap import ...` offers, by the module it comes from. Made from the
docstrings by `./run python docs/make_reference.py`; do not edit. Shapes are written as in
`Float[Array, "agent 2"]`: one row of two numbers for each agent.
"""
ALIASES = {
    "Union[Key[Array, ''], UInt32[Array, '2'], UInt32[Array, '4']]": "Key",
    "Float[Array, 'agent du']": "Action",
    "Float[Array, 'agent obs']": "Obs",
    "Bool[Array, 'agent agent']": "Links",
    "Float[Array, '']": "Scalar",
    "Callable[[State, Key], Action]": "Controller",
    "Callable[[Obs, Key], Action]": "Policy",
}
SECTIONS = {
    "games": "Tasks and plants",
    "tasks": "Built-in tasks",
    "types": "States, actions, observations",
    "learning": "Learning",
    "runs": "Training and runs on disk",
    "sweeps": "Many runs",
    "report": "Figures",
    "simulation": "Playing and measuring",
    "controllers": "Controllers",
    "certificates": "Certificates",
    "errors": "Errors",
}


def page() -> str:
    """The whole page as Markdown."""
    parts = [HEAD]
    for folder, title in SECTIONS.items():
        modules = [m for m in sorted(marlyap.PUBLIC) if m.partition(".")[0] == folder]
        parts.append(f"\n## {title}\n")
        parts += [_entry(name, m) for m in modules for name in marlyap.PUBLIC[m]]
    return "\n".join(parts)


def _entry(name: str, module: str) -> str:
    thing = getattr(marlyap, name)
    lines = [f"### {name}\n", f"*marlyap.{module}*\n"]
    if inspect.isclass(thing):
        lines += [*_class(thing)]
    elif inspect.isfunction(thing):
        lines += [f"```\n{_signature(name, thing)}\n```\n", _prose(thing)]
    else:
        text = re.sub(r"\b(?:\w+\.)+(?=\w)", "", inspect.formatannotation(thing))
        lines.append(f"The type `{text}`.\n")
    return "\n".join(lines)


def _class(cls: type) -> list[str]:
    lines = [_prose(cls)]
    bases = [b.__name__ for b in cls.__bases__ if b.__module__.startswith("marlyap.")]
    if bases:
        lines.append(f"A kind of {', '.join(f'`{b}`' for b in bases)}.\n")
    if dataclasses.is_dataclass(cls) or hasattr(cls, "_fields"):
        lines += _fields(cls)
    own = {k: v for k, v in vars(cls).items() if not k.startswith("_")}
    for name, member in own.items():
        function = _function(member)
        if function is None or not function.__doc__:
            continue  # what a base class describes is described there
        if isinstance(member, property):
            head = f"`.{name}` -> `{_plain(function.__annotations__.get('return', '?'))}`"
        else:
            head = f"`{_signature(name, function)}`"
        must = " (to be defined)" if getattr(member, "__isabstractmethod__", False) else ""
        lines.append(f"* {head}{must}: {_indented(_prose(function))}")
    return lines


def _fields(cls: type) -> list[str]:
    from marlyap.runs.config import _comments

    inherited = {f.name for base in cls.__bases__ for f in _of(base)}
    notes, rows = _comments(cls), []
    for f in _of(cls):
        if f.name in inherited:
            continue
        value = "" if f.default is dataclasses.MISSING else f" = {_value(f.default)}"
        note = f": {notes[f.name]}" if notes.get(f.name) else ""
        rows.append(f"* `{f.name}{value}`{note}")
    return [*rows, ""] if rows else []


def _of(cls: type) -> tuple:
    return dataclasses.fields(cls) if dataclasses.is_dataclass(cls) else ()


def _value(value: object) -> str:
    if inspect.isroutine(value):
        return value.__name__
    return f"{type(value).__name__}()" if dataclasses.is_dataclass(value) else repr(value)


def _function(member: object):
    """The function behind a method or a property; None for anything else."""
    for inner in (getattr(member, "fget", None), getattr(member, "__func__", None), member):
        if callable(inner) and inspect.isfunction(function := inspect.unwrap(inner)):
            return function
    return None


def _signature(name: str, function) -> str:
    signature = inspect.signature(function)
    plain = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    words = []
    for p in plain:
        kind = "" if p.annotation is p.empty else f": {_plain(p.annotation)}"
        default = "" if p.default is p.empty else f" = {_value(p.default)}"
        star = {p.VAR_POSITIONAL: "*", p.VAR_KEYWORD: "**"}.get(p.kind, "")
        words.append(f"{star}{p.name}{kind}{default}")
    back = signature.return_annotation
    gives = "" if back is signature.empty else f" -> {_plain(back)}"
    return f"{name}({', '.join(words)}){gives}"


def _plain(annotation: object) -> str:
    """A type as one would write it: without the modules of its parts, long ones by their names."""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    text = re.sub(r"\b(?:\w+\.)+(?=\w)", "", text).strip("'")
    for long, short in ALIASES.items():
        text = text.replace(long, short)
    return text


def _prose(thing) -> str:
    return (inspect.getdoc(thing) or "") + "\n"


def _indented(text: str) -> str:
    return text.strip().replace("\n", "\n  ")


if __name__ == "__main__":
    PAGE.write_text(page())
