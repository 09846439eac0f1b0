"""Partial evaluation of a term's kernel: plain statements on scalars for one rig and one joint.

A kernel is written for any number of joints, on arrays (`analysis.terms.base`). Here its source is
evaluated as far as possible without samples: the phase, the number of joints and the joint of the
term are numbers, loops over joints are unrolled, and every array element becomes a variable. The
floating-point operations and their order stay those of the kernel, so that results agree to the
last bit. A function that a kernel calls is copied with it, once for every set of integer arguments;
array arguments are replaced by the elements that it reads.
"""

from __future__ import annotations

import ast
import inspect
import math
import operator
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, Final

import numpy as np

_BINARY: Final[dict[type[ast.operator], Callable[[int, int], int]]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
}
_COMPARE: Final[dict[type[ast.cmpop], Callable[[int, int], bool]]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_BUILTINS: Final = ("abs", "max", "min", "float")


class NotSpecialisable(Exception):
    """A kernel uses what cannot be evaluated before the simulation; the message names it."""


@dataclass(frozen=True)
class ScalarArray:
    """An array whose elements are variables, named `name` and their indices increased by `first`.

    `values` are elements known beforehand, from which `int(par[k])` takes a joint's index.
    """

    name: str
    shape: tuple[int, ...]
    first: int = 0
    values: tuple[float, ...] = ()

    def variable(self, index: tuple[int, ...]) -> str:
        """Return the variable of the element at `index`; raises NotSpecialisable outside."""
        inside = len(index) == len(self.shape) and all(
            0 <= k < n for k, n in zip(index, self.shape, strict=True)
        )
        if not inside:
            raise NotSpecialisable(f"{self.name}{list(index)} lies outside {self.shape}")
        return self.name + "_".join(str(k + self.first) for k in index)


@dataclass
class Helpers:
    """The functions copied with the kernels: text by name, each once."""

    texts: dict[str, str] = field(default_factory=dict)
    names: dict[tuple[Any, ...], tuple[str, tuple[str, ...]]] = field(default_factory=dict)

    def copy(
        self, dispatcher: Any, arrays: Mapping[str, ScalarArray], numbers: Mapping[str, int]
    ) -> tuple[str, tuple[str, ...]]:
        """Copy a function; return its name and the elements it reads of `arrays` (by parameter).

        `numbers` are the parameters that are known integers.
        """
        key = (dispatcher, *sorted(arrays.items()), *sorted(numbers.items()))
        if key in self.names:
            return self.names[key]
        function = dispatcher.py_func
        tree = _definition(function)
        body = _Body(function, tree, arrays, self, "", inlined=False)
        if changed := set(numbers) & body.stored:
            raise NotSpecialisable(f"{function.__name__} changes its argument {min(changed)!r}")
        body.known.update(numbers)
        statements = body.block(tree.body)
        if body.written:
            raise NotSpecialisable(f"{function.__name__} changes an array that it is handed")
        read = tuple(sorted(body.read))
        name = f"{function.__name__.strip('_')}_{len(self.names) + 1}"
        self.names[key] = name, read
        parameters = [a.arg for a in tree.args.args if a.arg not in arrays and a.arg not in numbers]
        model = dispatcher.targetoptions.get("error_model", "python")
        head = f"@njit(error_model={model!r})\ndef {name}({', '.join([*parameters, *read])}):\n"
        self.texts[name] = head + textwrap.indent(_unparse(statements), "    ")
        return name, read


@dataclass(frozen=True)
class Specialised:
    """Statements of a specialised kernel, the variables that they read, and its fixed indices.

    `places` holds, by variable, the elements that were read as integers: the lines have their
    values as constants.
    """

    lines: tuple[str, ...]
    read: frozenset[str]
    places: Mapping[str, int]


def specialised(
    function: Callable[..., None],
    numbers: Mapping[str, int],
    arrays: Mapping[str, ScalarArray],
    prefix: str,
    helpers: Helpers,
) -> Specialised:
    """Return a kernel's statements; the names of its local variables begin with `prefix`.

    `numbers` are parameters known now (the phase), `arrays` the others. Raises NotSpecialisable.
    """
    tree = _definition(function)
    body = _Body(function, tree, arrays, helpers, prefix, inlined=True)
    body.known.update(numbers)
    lines = _unparse(body.block(tree.body)).splitlines()
    return Specialised(tuple(lines), frozenset(body.read), body.places)


def _definition(function: Callable[..., Any]) -> ast.FunctionDef:
    try:
        tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    except (OSError, TypeError, SyntaxError) as error:
        raise NotSpecialisable(f"the source of {function!r} cannot be read: {error}") from error
    definition = tree.body[0]
    if not isinstance(definition, ast.FunctionDef):
        raise NotSpecialisable(f"{function!r} is not a plain function")
    return definition


def _unparse(statements: Sequence[ast.stmt]) -> str:
    module = ast.Module(list(statements) or [ast.Pass()], [])
    return ast.unparse(ast.fix_missing_locations(module)) + "\n"


def _constant(node: ast.expr) -> Any:
    return node.value if isinstance(node, ast.Constant) else None


def _whole(node: ast.expr) -> int | None:
    """Return the value of an integer constant (not a bool), None for any other expression."""
    value = _constant(node)
    return value if isinstance(value, int) and not isinstance(value, bool) else None


class _Body(ast.NodeTransformer):
    """The statements of one function, evaluated as far as known numbers allow."""

    def __init__(
        self, function: Callable[..., Any], tree: ast.FunctionDef,
        arrays: Mapping[str, ScalarArray], helpers: Helpers, prefix: str, *, inlined: bool,
    ) -> None:  # fmt: skip
        self.globals = inspect.getclosurevars(function).globals
        self.arrays, self.helpers, self.prefix, self.inlined = arrays, helpers, prefix, inlined
        self.known: dict[str, int] = {}
        self.read: set[str] = set()
        self.written: set[str] = set()
        self.places: dict[str, int] = {}
        names = [n for n in ast.walk(tree) if isinstance(n, ast.Name)]
        stored = [n.id for n in names if isinstance(n.ctx, ast.Store)]
        self.stored = set(stored)
        self.locals = {*stored, *(a.arg for a in tree.args.args)}
        self.stored_once = {name for name in stored if stored.count(name) == 1}

    # Statements.

    def block(self, statements: Sequence[ast.stmt]) -> list[ast.stmt]:
        """Return the statements evaluated; those after an early end become its `if`'s `else`."""
        out: list[ast.stmt] = []
        for k, statement in enumerate(statements):
            if isinstance(statement, ast.If):
                test = self.visit(statement.test)
                known = _constant(test)
                body, rest = statement.body, [*statement.orelse, *statements[k + 1 :]]
                ends_block = self._ends_block(body)
                if known is not None:
                    if known and ends_block:
                        return [*out, *self.block(body[:-1])]
                    out += self.block(body if known else statement.orelse)
                    continue
                if ends_block:
                    return [*out, self._if_statement(test, body[:-1], rest)]
                out.append(self._if_statement(test, body, statement.orelse))
            elif self._ends_block([statement]):
                return out
            else:
                out += self._plain(statement)
        return out

    def _ends_block(self, body: Sequence[ast.stmt]) -> bool:
        """Return whether a block ends in `return` or `continue` of an inlined kernel."""
        return self.inlined and isinstance(body[-1], ast.Return | ast.Continue)

    def _if_statement(
        self, test: ast.expr, body: Sequence[ast.stmt], other: Sequence[ast.stmt]
    ) -> ast.stmt:
        return ast.If(test, self.block(body) or [ast.Pass()], self.block(other))

    def _plain(self, statement: ast.stmt) -> list[ast.stmt]:
        """Return a statement other than `if`, evaluated: none, one, or the passes of a loop."""
        match statement:
            case ast.Pass() | ast.Expr(value=ast.Constant()):
                out: list[ast.stmt] = []
            case ast.For(target=ast.Name(id=name), iter=ast.Call(func=ast.Name(id="range"))):
                out = self._loop(statement, name)
            case ast.Assign(targets=[target]):
                out = self._assigned(target, self.visit(statement.value))
            case ast.AugAssign():
                value, target = self.visit(statement.value), self.visit(statement.target)
                if isinstance(statement.target, ast.Subscript):
                    self.read.add(target.id)
                out = [ast.AugAssign(target, statement.op, value)]
            case ast.Return(value=ast.expr() as value) if not self.inlined:
                out = [ast.Return(self.visit(value))]
            case ast.Break() | ast.Continue() if not self.inlined:
                out = [statement]
            case _:
                text = ast.unparse(statement).splitlines()[0]
                raise NotSpecialisable(f"line {statement.lineno}: {text}")
        return out

    def _assigned(self, target: ast.expr, value: ast.expr) -> list[ast.stmt]:
        whole = _whole(value)
        if isinstance(target, ast.Name) and whole is not None and target.id in self.stored_once:
            self.known[target.id] = whole
            return []
        return [ast.Assign([self.visit(target)], value, lineno=0)]

    def _loop(self, loop: ast.For, name: str) -> list[ast.stmt]:
        assert isinstance(loop.iter, ast.Call)
        ends = [_whole(self.visit(end)) for end in loop.iter.args]
        if loop.orelse or any(end is None for end in ends):
            raise NotSpecialisable(f"line {loop.lineno}: the loop over {name} has no fixed length")
        numbers = [end for end in ends if end is not None]
        early = (ast.Break, ast.Return) if self.inlined else (ast.Break, ast.Return, ast.Continue)
        ends_early = any(isinstance(n, early) for n in ast.walk(loop))
        if ends_early and self.inlined:
            raise NotSpecialisable(f"line {loop.lineno}: the loop over {name} is left early")
        nodes = (n for part in loop.body for n in ast.walk(part))
        if ends_early or not any(isinstance(n, ast.Name) and n.id == name for n in nodes):
            target = ast.Name(self.prefix + name, ast.Store())
            passes = ast.Call(ast.Name("range", ast.Load()), list(map(ast.Constant, numbers)), [])
            return [ast.For(target, passes, self.block(loop.body) or [ast.Pass()], [], lineno=0)]
        out: list[ast.stmt] = []
        for value in range(*numbers):
            self.known[name] = value
            out += self.block(loop.body)
        return out

    # Expressions.

    def generic_visit(self, node: ast.AST) -> ast.expr:
        """Refuse every other expression."""
        raise NotSpecialisable(f"line {getattr(node, 'lineno', '?')}: {ast.unparse(node)}")

    def visit_Constant(self, node: ast.Constant) -> ast.expr:
        """Keep a constant."""
        return node

    def visit_Tuple(self, node: ast.Tuple) -> ast.expr:
        """Evaluate every part."""
        return ast.Tuple([self.visit(part) for part in node.elts], node.ctx)

    def visit_Name(self, node: ast.Name) -> ast.expr:
        """Replace known variables by their numbers, and prefix local variables."""
        if isinstance(node.ctx, ast.Load) and node.id in self.known:
            return ast.Constant(self.known[node.id])
        if node.id in self.arrays:
            raise NotSpecialisable(f"line {node.lineno}: {node.id!r} is used as a whole")
        if node.id in self.locals:
            return ast.Name(self.prefix + node.id, node.ctx)
        value = self.globals.get(node.id)
        if isinstance(value, bool | int | float):
            return ast.Constant(value)
        raise NotSpecialisable(f"line {node.lineno}: {node.id!r} is not a number")

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        """Replace a module's number (math.pi) by its value."""
        if isinstance(node.value, ast.Name):
            value = getattr(self.globals.get(node.value.id), node.attr, None)
            if isinstance(value, int | float):
                return ast.Constant(value)
        raise NotSpecialisable(f"line {node.lineno}: {ast.unparse(node)}")

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        """Replace an array's element by its variable, `x.shape[1]` by its number."""
        match node.value:
            case ast.Attribute(value=ast.Name(id=name), attr="shape") if name in self.arrays:
                axis = _whole(self.visit(node.slice))
                if axis is not None:
                    return ast.Constant(self.arrays[name].shape[axis])
            case ast.Name(id=name) if name in self.arrays:
                parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
                index = [_whole(self.visit(part)) for part in parts]
                if all(k is not None for k in index):
                    variable = self.arrays[name].variable(tuple(k for k in index if k is not None))
                    (self.read if isinstance(node.ctx, ast.Load) else self.written).add(variable)
                    return ast.Name(variable, node.ctx)
            case ast.Call() if isinstance(_constant(node.slice), int):  # one of several results
                return ast.Subscript(self.visit(node.value), node.slice, node.ctx)
        raise NotSpecialisable(f"line {node.lineno}: {ast.unparse(node)} has no fixed place")

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """Evaluate `int(par[k])` and `len`, copy other functions."""
        if node.keywords:
            raise NotSpecialisable(f"line {node.lineno}: {ast.unparse(node)} names an argument")
        match node:
            case ast.Call(func=ast.Name(id="int"), args=[ast.Subscript() as element]):
                return ast.Constant(self._place(element))
            case ast.Call(func=ast.Name(id="len"), args=[ast.Name(id=n)]) if n in self.arrays:
                return ast.Constant(self.arrays[n].shape[0])
            case ast.Call(func=ast.Name(id=name)) if name in _BUILTINS:
                return ast.Call(node.func, [self.visit(a) for a in node.args], [])
            case ast.Call(func=ast.Attribute(value=ast.Name(id=module), attr=name)):
                return self._library(node, module, name)
            case ast.Call(func=ast.Name(id=name)) if hasattr(self.globals.get(name), "py_func"):
                return self._helper(node, self.globals[name])
        raise NotSpecialisable(f"line {node.lineno}: {ast.unparse(node.func)} is not compiled")

    def _library(self, node: ast.Call, module: str, name: str) -> ast.expr:
        for short, known in (("math", math), ("np", np)):
            if self.globals.get(module) is known and isinstance(known, ModuleType):
                function = ast.Attribute(ast.Name(short, ast.Load()), name, ast.Load())
                return ast.Call(function, [self.visit(a) for a in node.args], [])
        raise NotSpecialisable(f"line {node.lineno}: {module}.{name} is neither math's nor numpy's")

    def _helper(self, node: ast.Call, dispatcher: Any) -> ast.expr:
        names = list(inspect.signature(dispatcher.py_func).parameters)
        if len(names) != len(node.args):
            raise NotSpecialisable(f"line {node.lineno}: {ast.unparse(node)} leaves arguments out")
        array_arguments = {
            parameter: self.arrays[argument.id]
            for parameter, argument in zip(names, node.args, strict=True)
            if isinstance(argument, ast.Name) and argument.id in self.arrays
        }
        values = {
            parameter: self.visit(argument)
            for parameter, argument in zip(names, node.args, strict=True)
            if parameter not in array_arguments
        }
        numbers = {p: whole for p, v in values.items() if (whole := _whole(v)) is not None}
        name, read = self.helpers.copy(dispatcher, array_arguments, numbers)
        others = [value for parameter, value in values.items() if parameter not in numbers]
        self.read.update(read)
        elements = [ast.Name(variable, ast.Load()) for variable in read]
        return ast.Call(ast.Name(name, ast.Load()), [*others, *elements], [])

    def _place(self, element: ast.Subscript) -> int:
        """Return the joint's index (0-based) that a kernel reads from `par`."""
        index = _whole(self.visit(element.slice))
        if isinstance(element.value, ast.Name) and index is not None:
            array = self.arrays.get(element.value.id)
            if array is not None and index < len(array.values):
                value = array.values[index]
                if self.inlined and value == int(value):
                    self.places[array.variable((index,))] = int(value)
                    return int(value)
        raise NotSpecialisable(f"line {element.lineno}: int({ast.unparse(element)}) is no place")

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        """Evaluate operations on known integers; keep those on floats."""
        left, right = self.visit(node.left), self.visit(node.right)
        a, b = _whole(left), _whole(right)
        if a is not None and b is not None and type(node.op) in _BINARY:
            return ast.Constant(_BINARY[type(node.op)](a, b))
        return ast.BinOp(left, node.op, right)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.expr:
        """Evaluate the sign of a known integer and `not` of a known bool."""
        operand = self.visit(node.operand)
        whole = _whole(operand)
        if isinstance(node.op, ast.USub) and whole is not None:
            return ast.Constant(-whole)
        if isinstance(node.op, ast.Not) and isinstance(_constant(operand), bool):
            return ast.Constant(not _constant(operand))
        return ast.UnaryOp(node.op, operand)

    def visit_Compare(self, node: ast.Compare) -> ast.expr:
        """Evaluate comparisons of known integers."""
        left, rights = self.visit(node.left), [self.visit(c) for c in node.comparators]
        a, b = _whole(left), _whole(rights[0])
        if len(rights) == 1 and a is not None and b is not None and type(node.ops[0]) in _COMPARE:
            return ast.Constant(_COMPARE[type(node.ops[0])](a, b))
        return ast.Compare(left, node.ops, rights)

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.expr:
        """Evaluate `and` and `or` as far as their parts are known."""
        decides = isinstance(node.op, ast.Or)
        undecided: list[ast.expr] = []
        for part in node.values:
            value = self.visit(part)
            if isinstance(_constant(value), bool):
                if _constant(value) is decides:
                    return ast.Constant(decides)
                continue
            undecided.append(value)
        if not undecided:
            return ast.Constant(not decides)
        return undecided[0] if len(undecided) == 1 else ast.BoolOp(node.op, undecided)

    def visit_IfExp(self, node: ast.IfExp) -> ast.expr:
        """Choose the branch where the test is known."""
        test = self.visit(node.test)
        known = _constant(test)
        if known is not None:
            return self.visit(node.body if known else node.orelse)  # type: ignore[no-any-return]
        return ast.IfExp(test, self.visit(node.body), self.visit(node.orelse))
