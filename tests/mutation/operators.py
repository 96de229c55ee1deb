"""What a mutant is: one function (or constant) of a module with one place of its syntax tree changed."""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import hil.signals

ROOT = Path(__file__).resolve().parents[2]
ENUMS = ("DriveState", "Reason", "Controlword", "RxFlag", "GuardFlag", "Request", "Word")
COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Gt: (ast.GtE, ast.Lt),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Lt: (ast.LtE, ast.Gt),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
}
COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.Mod: ast.Mult,
}
KINDS = (ast.FunctionDef, ast.Assign)
SWAPPED = {"min": "max", "max": "min"}
Place = tuple[ast.AST, str, int | None]


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: ``tree`` is the changed function, or the changed assignment of a constant."""

    file: str
    name: str
    line: int
    before: str
    after: str
    tree: ast.FunctionDef | ast.Assign
    key: str = ""
    """Name of the mutant in the list of equivalents."""


def variants(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what may stand in place of ``node``: each a mistake that one could have made."""
    match node:
        case ast.Compare(left=left, ops=[op], comparators=right):
            yield from (ast.Compare(left, [other()], right) for other in COMPARED.get(type(op), ()))
        case ast.BoolOp(op=op, values=values):
            yield ast.BoolOp(ast.Or() if isinstance(op, ast.And) else ast.And(), values)
            for i in range(len(values)):
                kept = values[:i] + values[i + 1 :]
                yield kept[0] if len(kept) == 1 else ast.BoolOp(op, kept)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in COMPUTED:
            yield ast.BinOp(left, COMPUTED[type(op)](), right)
        case ast.AugAssign(target=target, op=op, value=value) if type(op) in COMPUTED:
            yield ast.AugAssign(target, COMPUTED[type(op)](), value)
            yield ast.Pass()
        case ast.UnaryOp(operand=operand):
            yield operand
        case ast.Constant(value=int() | float()) if not isinstance(node.value, bool):
            yield from (ast.Constant(node.value + 1), ast.Constant(node.value - 1))
        case ast.Call(func=ast.Name(id=name), args=arguments):
            yield from called(name, arguments)
        case ast.IfExp(body=body, orelse=orelse):
            yield from (body, orelse)
        case ast.Attribute(value=ast.Name(id=enum), attr=member) if enum in ENUMS:
            yield from other_members(node, enum, member)
        case ast.If(body=body, orelse=orelse):
            yield from (ast.If(ast.Constant(taken), body, orelse) for taken in (True, False))
        case ast.Assign() | ast.Expr(value=ast.Call()):
            yield ast.Pass()


def called(name: str, arguments: list[ast.expr]) -> Iterator[ast.AST]:
    """Yield what a call may have been meant as."""
    if name in SWAPPED:
        yield ast.Call(ast.Name(SWAPPED[name], ast.Load()), arguments, [])
    elif name == "abs":
        yield arguments[0]
    elif name == "first":
        yield from arguments


def other_members(node: ast.Attribute, enum: str, member: str) -> Iterator[ast.AST]:
    """Yield the next member of the same enumeration in place of one."""
    names = [each.name for each in getattr(hil.signals, enum, ())]
    if member in names:
        yield ast.Attribute(node.value, names[(names.index(member) + 1) % len(names)], ast.Load())


def places(tree: ast.AST) -> Iterator[Place]:
    """Yield every place of a node: parent, field and index."""
    for parent in ast.walk(tree):
        for name, value in ast.iter_fields(parent):
            if isinstance(value, list):
                yield from ((parent, name, i) for i, item in enumerate(value) if isinstance(item, ast.AST))
            elif isinstance(value, ast.AST):
                yield parent, name, None


def at(place: Place) -> Any:
    parent, name, index = place
    value = getattr(parent, name)
    return value if index is None else value[index]


def put(place: Place, new: ast.AST) -> None:
    parent, name, index = place
    if index is None:
        setattr(parent, name, new)
    else:
        getattr(parent, name)[index] = new


def text(node: ast.AST) -> str:
    """First line of a node's source."""
    return ast.unparse(ast.fix_missing_locations(copy.deepcopy(node))).splitlines()[0]


def mutate(file: str, name: str, bare: ast.FunctionDef | ast.Assign) -> Iterator[Mutant]:
    """Yield every mutant of one function or constant."""
    for number, place in enumerate(places(bare)):
        original = at(place)
        for choice, _ in enumerate(variants(original)):
            tree = copy.deepcopy(bare)
            there = list(places(tree))[number]
            old = at(there)
            new = list(variants(old))[choice]
            before, after = text(old), text(new)
            put(there, new)
            yield Mutant(file, name, original.lineno, before, after, ast.fix_missing_locations(tree))


def stripped(function: ast.FunctionDef) -> ast.FunctionDef:
    """A copy without decorators and annotations, which are nothing that a tick computes with."""
    bare = copy.deepcopy(function)
    bare.decorator_list, bare.returns = [], None
    for argument in bare.args.args:
        argument.annotation = None
    return bare


def mutants(file: str) -> list[Mutant]:
    """Every mutant of the functions, methods and whole-number constants of a module."""
    found: list[Mutant] = []
    source = (ROOT / file).read_text(encoding="utf-8")
    for node in ast.parse(source).body:
        match node:
            case ast.FunctionDef(name=name):
                found += mutate(file, name, stripped(node))
            case ast.ClassDef(name=name, body=body):
                methods = [each for each in body if isinstance(each, ast.FunctionDef)]
                for method in methods:
                    found += mutate(file, f"{name}.{method.name}", stripped(method))
            case ast.AnnAssign(target=ast.Name(id=name), value=ast.Constant(value=int())):
                found += mutate(file, name, ast.copy_location(ast.Assign([node.target], node.value), node))
            case ast.Assign(targets=[ast.Name(id=name)], value=ast.Constant(value=int())):
                found += mutate(file, name, node)
    return list(named([mutant for mutant in found if isinstance(mutant.tree, KINDS)], source.splitlines()))


def named(found: list[Mutant], lines: list[str]) -> Iterator[Mutant]:
    """Give each mutant its key: by the text of its line, so that it holds when lines move."""
    counts: Counter[str] = Counter()
    for mutant in found:
        line = lines[mutant.line - 1].strip()
        key = f"{mutant.file}:{mutant.name}: {line} | {mutant.before} => {mutant.after}"
        counts[key] += 1
        yield replace(mutant, key=key if counts[key] == 1 else f"{key} #{counts[key]}")
