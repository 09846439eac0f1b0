"""Translate terms' kernels, numba functions on scalars and arrays, into C.

The translation covers the language of kernels: numbers, arrays indexed by element, loops over
`range`, branches, tuples returned or assigned, calls of `math` functions and of other compiled
functions, which are translated for the kinds of their arguments. Anything else is refused by name,
so that no kernel is translated wrongly.

Kinds of values: `int`, `double`, a vector (`double *`), a matrix (`double *` with the number of
joints `N` as its row length), a tuple of numbers (a C struct).
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

INT, DOUBLE, VECTOR, MATRIX = "int", "double", "vector", "matrix"
KERNEL_KINDS: Final = (INT, VECTOR, MATRIX, VECTOR, VECTOR, MATRIX, MATRIX, VECTOR)
_C_TYPES: Final = {INT: "int", DOUBLE: "double", VECTOR: "double *", MATRIX: "double *"}
_MATH: Final = {
    "sin", "cos", "tan", "tanh", "atan", "sqrt", "exp", "log", "erf", "hypot", "fabs", "copysign",
    "asin", "acos", "atan2", "floor", "ceil", "pow", "sinh", "cosh",
}  # fmt: skip
_BUILT_IN: Final = {  # name and number of arguments -> C, kind
    ("abs", 1): ("fabs", DOUBLE),
    ("int", 1): ("(int)", INT),
    ("float", 1): ("(double)", DOUBLE),
    ("max", 2): ("fmax", DOUBLE),
    ("min", 2): ("fmin", DOUBLE),
}
_BINARY: Final = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
_COMPARE: Final = {
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip


class UntranslatableKernelError(Exception):
    """A kernel has a construct without translation into C; names it and the function."""


@dataclass(frozen=True)
class CValue:
    """A C expression and the kind of its value; `size` is a tuple's length."""

    text: str
    kind: str
    size: int = 0


@dataclass
class KernelLibrary:
    """C functions translated so far, in the order in which C needs them."""

    functions: dict[tuple[Any, ...], str] = field(default_factory=dict)  # key -> C name
    returns: dict[str, tuple[str, int]] = field(default_factory=dict)  # C name -> kind, size
    texts: list[str] = field(default_factory=list)

    def add(self, function: Callable[..., Any], kinds: Sequence[str], name: str = "") -> str:
        """Translate a function for arguments of these kinds, once; return its name in C.

        Raises UntranslatableKernelError.
        """
        python_function = getattr(function, "py_func", function)
        key = (python_function, tuple(kinds))
        if key not in self.functions:
            c_name = name or f"f{len(self.functions)}_{python_function.__name__.strip('_')}"
            self.functions[key] = c_name
            _Translation(python_function, tuple(kinds), c_name, self).write()
        return self.functions[key]

    @property
    def source(self) -> str:
        """All functions as C, callees first."""
        return "\n".join(self.texts)


class _Translation:
    """One function being translated: kinds of its variables, lines written, temporaries."""

    def __init__(
        self,
        function: Callable[..., Any],
        kinds: tuple[str, ...],
        name: str,
        library: KernelLibrary,
    ) -> None:
        self.name, self.library = name, library
        self.globals: Mapping[str, Any] = function.__globals__
        self.label = f"{function.__module__}.{function.__name__}"
        tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
        assert isinstance(tree, ast.FunctionDef)
        self.tree = tree
        names = [argument.arg for argument in tree.args.args]
        if len(names) != len(kinds):
            raise self._refusal(tree, f"{len(kinds)} arguments")
        self.arguments = dict(zip(names, kinds, strict=True))
        self.locals: dict[str, str] = {}
        self.lines: list[str] = []
        self.depth = 1
        self.temporaries = 0
        self.result: tuple[str, int] | None = None

    def write(self) -> None:
        """Translate the body and add the function to the library."""
        self._block(self.tree.body)
        kind, size = self.result or ("void", 0)
        returned = f"struct tuple{size}" if size else kind
        arguments = ", ".join(f"{_C_TYPES[k]} {_safe(n)}" for n, k in self.arguments.items())
        declared = [f"    {_C_TYPES[k]} {_safe(n)} = 0;" for n, k in self.locals.items()]
        body = "\n".join([*declared, *self.lines])
        self.library.returns[self.name] = (kind, size)
        self.library.texts.append(
            f"/* {self.label} */\nstatic {returned} {self.name}({arguments})\n{{\n{body}\n}}\n"
        )

    # -- statements ----------------------------------------------------------------------------

    def _block(self, body: Sequence[ast.stmt]) -> None:
        for statement in body:
            self._statement(statement)

    def _line(self, text: str) -> None:
        self.lines.append("    " * self.depth + text)

    def _nested(self, head: str, body: Sequence[ast.stmt]) -> None:
        self._line(head + " {")
        self.depth += 1
        self._block(body)
        self.depth -= 1
        self._line("}")

    def _statement(self, node: ast.stmt) -> None:
        match node:
            case ast.Pass() | ast.Expr(value=ast.Constant(value=str())):
                pass
            case ast.Break():
                self._line("break;")
            case ast.Continue():
                self._line("continue;")
            case ast.Return(value=value):
                self._return(value)
            case ast.If(test=test, body=body, orelse=orelse):
                self._nested(f"if {_bracketed(self._value(test).text)}", body)
                if orelse:
                    self._nested("else", orelse)
            case ast.While(test=test, body=body, orelse=[]):
                self._nested(f"while {_bracketed(self._value(test).text)}", body)
            case ast.For(target=ast.Name(id=name), iter=source, body=body, orelse=[]):
                self._loop(name, source, body)
            case ast.Assign(targets=targets, value=value):
                self._assign_all(targets, value)
            case ast.AugAssign(target=target, op=operator, value=value):
                old = self._value(ast.parse(ast.unparse(target), mode="eval").body)
                new = self._binary(operator, old, self._value(value), node)
                self._store(target, new)
            case _:
                raise self._refusal(node, type(node).__name__)

    def _loop(self, name: str, source: ast.expr, body: Sequence[ast.stmt]) -> None:
        match source:
            case ast.Call(func=ast.Name(id="range"), args=arguments):
                values = [self._value(a) for a in arguments]
            case _:
                raise self._refusal(source, "a loop over something else than range")
        if any(v.kind != INT for v in values):
            raise self._refusal(source, "a range of numbers that are no integers")
        texts = [v.text for v in values]
        begin, end = ("0", texts[0]) if len(texts) == 1 else (texts[0], texts[1])
        step = texts[2] if len(texts) == 3 else "1"
        down = step.strip("()").startswith("-")
        i = self._declare(name, INT)
        head = f"for ({i} = {begin}; {i} {'>' if down else '<'} {end}; {i} += {step})"
        self._nested(head, body)

    def _return(self, value: ast.expr | None) -> None:
        if value is None:
            self._line("return;")
            return
        returned = self._tuple(value) if isinstance(value, ast.Tuple) else self._value(value)
        kind = (DOUBLE if not returned.size else "tuple", returned.size)
        if self.result not in (None, kind):
            raise self._refusal(value, "results of different kinds")
        self.result = kind
        self._line(f"return {returned.text};")

    def _assign_all(self, targets: Sequence[ast.expr], value: ast.expr) -> None:
        if len(targets) == 1 and isinstance(targets[0], ast.Tuple):
            self._unpack(targets[0].elts, value)
            return
        assigned = self._value(value)
        for target in reversed(targets):
            self._store(target, assigned)

    def _unpack(self, targets: Sequence[ast.expr], value: ast.expr) -> None:
        """Assign a tuple to targets: every value is computed before the first is stored."""
        if isinstance(value, ast.IfExp):
            self._line(f"if {_bracketed(self._value(value.test).text)} {{")
            self._unpack(targets, value.body)
            self._line("} else {")
            self._unpack(targets, value.orelse)
            self._line("}")
            return
        if isinstance(value, ast.Tuple):
            values = [self._value(v) for v in value.elts]
        else:
            result = self._value(value)
            self.temporaries += 1
            temporary = f"t{self.temporaries}"
            self._line(f"struct tuple{result.size} {temporary} = {result.text};")
            values = [CValue(f"{temporary}.v[{k}]", DOUBLE) for k in range(result.size)]
        if len(values) != len(targets):
            raise self._refusal(value, f"{len(values)} values for {len(targets)} targets")
        copies = []
        for element in values:
            self.temporaries += 1
            self._line(f"{_C_TYPES[element.kind]} t{self.temporaries} = {element.text};")
            copies.append(CValue(f"t{self.temporaries}", element.kind))
        for target, element in zip(targets, copies, strict=True):
            self._store(target, element)

    def _store(self, target: ast.expr, value: CValue) -> None:
        if isinstance(target, ast.Name):
            self._line(f"{self._declare(target.id, value.kind)} = {value.text};")
            return
        if isinstance(target, ast.Subscript):
            self._line(f"{self._element(target).text} = {value.text};")
            return
        raise self._refusal(target, "a target")

    def _declare(self, name: str, kind: str) -> str:
        if name in self.arguments:
            return _safe(name)
        declared = self.locals.get(name)
        if declared is None or (declared == INT and kind == DOUBLE):
            self.locals[name] = kind
        return _safe(name)

    # -- expressions ---------------------------------------------------------------------------

    def _value(self, node: ast.expr) -> CValue:
        kinds: dict[type[ast.expr], Callable[[Any], CValue]] = {
            ast.Constant: self._constant,
            ast.Name: lambda n: self._name(n.id, n),
            ast.Subscript: self._subscript,
            ast.BinOp: lambda n: self._binary(n.op, self._value(n.left), self._value(n.right), n),
            ast.UnaryOp: self._unary,
            ast.BoolOp: self._logical,
            ast.Compare: lambda n: self._compare([n.left, *n.comparators], n.ops),
            ast.IfExp: self._choice,
            ast.Call: self._call,
        }
        translate = kinds.get(type(node))
        if translate is None:
            raise self._refusal(node, type(node).__name__)
        return translate(node)

    def _constant(self, node: ast.Constant) -> CValue:
        if isinstance(node.value, bool | int):
            return CValue(str(int(node.value)), INT)
        if isinstance(node.value, float):
            return CValue(repr(node.value), DOUBLE)
        raise self._refusal(node, f"the constant {node.value!r}")

    def _subscript(self, node: ast.Subscript) -> CValue:
        match node:
            case ast.Subscript(value=ast.Attribute(value=ast.Name(id=name), attr="shape")):
                if self.arguments.get(name) != MATRIX or ast.unparse(node.slice) != "1":
                    raise self._refusal(node, "a shape other than the number of joints")
                return CValue("N", INT)
            case ast.Subscript(value=ast.Call() as call, slice=ast.Constant(value=int() as k)):
                return CValue(f"{self._value(call).text}.v[{k}]", DOUBLE)
        return self._element(node)

    def _unary(self, node: ast.UnaryOp) -> CValue:
        operand = self._value(node.operand)
        if isinstance(node.op, ast.USub):
            return CValue(f"(-{operand.text})", operand.kind)
        if isinstance(node.op, ast.Not):
            return CValue(f"(!{operand.text})", INT)
        raise self._refusal(node, type(node.op).__name__)

    def _logical(self, node: ast.BoolOp) -> CValue:
        sign = " && " if isinstance(node.op, ast.And) else " || "
        return CValue(f"({sign.join(self._value(v).text for v in node.values)})", INT)

    def _choice(self, node: ast.IfExp) -> CValue:
        body, orelse = self._value(node.body), self._value(node.orelse)
        kind = DOUBLE if DOUBLE in (body.kind, orelse.kind) else body.kind
        return CValue(f"({self._value(node.test).text} ? {body.text} : {orelse.text})", kind)

    def _name(self, name: str, node: ast.expr) -> CValue:
        kind = self.locals.get(name) or self.arguments.get(name)
        if kind is not None:
            return CValue(_safe(name), kind)
        value = self.globals.get(name)
        if isinstance(value, bool | int):
            return CValue(str(int(value)), INT)
        if isinstance(value, float):
            return CValue(repr(value), DOUBLE)
        raise self._refusal(node, f"the name {name}")

    def _element(self, node: ast.Subscript) -> CValue:
        if not isinstance(node.value, ast.Name):
            raise self._refusal(node, "an element of something without a name")
        array = self._name(node.value.id, node)
        if array.kind == VECTOR:
            return CValue(f"{array.text}[{self._value(node.slice).text}]", DOUBLE)
        if array.kind == MATRIX and isinstance(node.slice, ast.Tuple):
            row, column = (self._value(index).text for index in node.slice.elts)
            return CValue(f"{array.text}[({row}) * N + ({column})]", DOUBLE)
        raise self._refusal(node, "an element of something that is no array")

    def _binary(self, operator: ast.operator, left: CValue, right: CValue, node: ast.AST) -> CValue:
        if isinstance(operator, ast.Pow):
            if right.text == "2":
                return CValue(f"({left.text} * {left.text})", DOUBLE)
            return CValue(f"pow({left.text}, {right.text})", DOUBLE)
        sign = _BINARY.get(type(operator))
        if sign is None:
            raise self._refusal(node, type(operator).__name__)
        integers = left.kind == right.kind == INT
        if sign == "/" and integers:
            return CValue(f"((double){left.text} / {right.text})", DOUBLE)
        return CValue(f"({left.text} {sign} {right.text})", INT if integers else DOUBLE)

    def _compare(self, nodes: Sequence[ast.expr], operators: Sequence[ast.cmpop]) -> CValue:
        values = [self._value(n).text for n in nodes]
        parts = [
            f"({values[k]} {_COMPARE[type(op)]} {values[k + 1]})" for k, op in enumerate(operators)
        ]
        return CValue(parts[0] if len(parts) == 1 else f"({' && '.join(parts)})", INT)

    def _call(self, node: ast.Call) -> CValue:
        if node.keywords:
            raise self._refusal(node, "an argument by name")
        values = [self._value(argument) for argument in node.args]
        texts = [v.text for v in values]
        match node.func:
            case ast.Attribute(value=ast.Name(id="math"), attr=name) if name in _MATH:
                return CValue(f"{name}({', '.join(texts)})", DOUBLE)
            case ast.Name(id=name) if (name, len(texts)) in _BUILT_IN:
                function, kind = _BUILT_IN[name, len(texts)]
                return CValue(f"{function}({', '.join(texts)})", kind)
            case ast.Name(id=name) if hasattr(self.globals.get(name), "py_func"):
                callee = self.library.add(self.globals[name], [v.kind for v in values])
                if callee not in self.library.returns:
                    raise self._refusal(node, "a function that calls itself")
                kind, size = self.library.returns[callee]
                return CValue(f"{callee}({', '.join(texts)})", kind, size)
        raise self._refusal(node, f"a call of {ast.unparse(node.func)}")

    def _tuple(self, node: ast.Tuple) -> CValue:
        texts = ", ".join(self._value(v).text for v in node.elts)
        size = len(node.elts)
        return CValue(f"(struct tuple{size}){{{{{texts}}}}}", "tuple", size)

    def _refusal(self, node: ast.AST, what: str) -> UntranslatableKernelError:
        line = getattr(node, "lineno", 0)
        return UntranslatableKernelError(
            f"{self.label}, line {line} of the function: {what} has no translation into C"
        )


def _safe(name: str) -> str:
    """Return a variable's name in C: apart from the macro N, types and temporaries."""
    return f"{name}_"


def _bracketed(text: str) -> str:
    return text if text.startswith("(") and text.endswith(")") else f"({text})"
