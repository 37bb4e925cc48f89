"""Reads a pickle of tensors without unpickling: nothing is imported, called or constructed.

``torch.save`` writes a pickle that names its tensors, and their values beside it. Training files also hold objects of
other programs, which ``torch.load(weights_only=True)`` refuses and which would run arbitrary code when unpickled.
This reader interprets the pickle's opcodes over plain values only. Lists, dictionaries with string keys and references
to tensors survive; every object, class and call becomes ``OTHER``.
"""

from __future__ import annotations

import pickletools
from dataclasses import dataclass
from typing import Any, Final

OTHER: Final = object()
"""Placeholder for everything in a pickle that is neither a plain value nor a tensor."""


@dataclass(frozen=True)
class StoredValues:
    """Values of one or several tensors: the class of their storage, the entry that holds them, and how many."""

    kind: str
    entry: str
    count: int


@dataclass(frozen=True)
class StoredTensor:
    """Where a tensor lies in its storage; all counts are values, not bytes."""

    values: StoredValues
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]


@dataclass(frozen=True)
class _Name:
    """A class or function that the pickle names."""

    path: str


_IGNORED = {"PROTO", "FRAME", "READONLY_BUFFER"}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_OTHER_FROM_MARK = {"FROZENSET", "OBJ", "INST"}
_DROP_TO_MARK = {"ADDITEMS", "POP_MARK"}
_PUT = {"PUT", "BINPUT", "LONG_BINPUT"}
_GET = {"GET", "BINGET", "LONG_BINGET"}
_OTHER_VALUES = {"EMPTY_SET", "EXT1", "EXT2", "EXT4", "PERSID", "NEXT_BUFFER"}


def read_tensor_pickle(data: bytes) -> object:
    """The pickled value, with ``StoredTensor`` for tensors and ``OTHER`` for everything else that is not a plain value.

    Time and memory are proportional to the length of ``data``, whatever its contents.

    Raises:
        ValueError: the pickle is truncated or malformed, or its tensors are.
    """
    # The pickle machine: a stack, marks on it that delimit argument lists, and a memo of shared values.
    stack: list[Any] = []
    marks: list[int] = []
    memo: dict[Any, Any] = {}

    def from_mark() -> list[Any]:
        start = marks.pop()
        items = stack[start:]
        del stack[start:]
        return items

    try:
        for code, argument, _ in pickletools.genops(data):
            name = code.name
            if name in _IGNORED:
                pass
            elif name == "STOP":
                return stack.pop()
            elif name == "MARK":
                marks.append(len(stack))
            elif name in _PUT:
                memo[argument] = stack[-1]
            elif name == "MEMOIZE":
                memo[len(memo)] = stack[-1]
            elif name in _GET:
                stack.append(memo[argument])
            elif name in _CONSTANTS:
                stack.append(_CONSTANTS[name])
            elif name in _OTHER_VALUES:
                stack.append(OTHER)
            elif name in _TUPLES:
                items = stack[-_TUPLES[name] :]
                del stack[-_TUPLES[name] :]
                stack.append(tuple(items))
            elif name == "EMPTY_TUPLE":
                stack.append(())
            elif name == "TUPLE":
                stack.append(tuple(from_mark()))
            elif name == "EMPTY_LIST":
                stack.append([])
            elif name == "LIST":
                stack.append(from_mark())
            elif name in ("APPEND", "APPENDS"):
                items = from_mark() if name == "APPENDS" else [stack.pop()]
                if isinstance(stack[-1], list):
                    stack[-1].extend(items)
            elif name == "EMPTY_DICT":
                stack.append({})
            elif name == "DICT":
                stack.append(_fill({}, from_mark()))
            elif name == "SETITEM":
                value, key = stack.pop(), stack.pop()
                _fill(stack[-1], [key, value])
            elif name == "SETITEMS":
                items = from_mark()
                _fill(stack[-1], items)
            elif name in _OTHER_FROM_MARK:
                from_mark()
                stack.append(OTHER)
            elif name in _DROP_TO_MARK:
                from_mark()
            # BUILD would set the state of an object: the object, ``OTHER``, stays, its state is dropped.
            elif name in ("BUILD", "POP"):
                stack.pop()
            elif name == "DUP":
                stack.append(stack[-1])
            elif name == "GLOBAL":
                stack.append(_Name(str(argument).replace(" ", ".")))
            elif name == "STACK_GLOBAL":
                last, module = stack.pop(), stack.pop()
                stack.append(_Name(f"{module}.{last}") if isinstance(module, str) and isinstance(last, str) else OTHER)
            elif name in ("REDUCE", "NEWOBJ"):
                arguments, called = stack.pop(), stack.pop()
                stack.append(_instead_of_call(called, arguments))
            elif name == "NEWOBJ_EX":
                del stack[-3:]
                stack.append(OTHER)
            elif name == "BINPERSID":
                stack.append(_stored_values(stack.pop()))
            elif code.arg is not None:  # the remaining opcodes with an argument push numbers, strings and bytes
                stack.append(argument)
            else:
                raise ValueError(f"unknown instruction {name}")
    except (IndexError, KeyError, OverflowError, DeprecationWarning) as error:  # the last: invalid escapes
        raise ValueError(f"malformed: {type(error).__name__}") from error
    raise ValueError("cut off")


def _fill(target: object, items: list[Any]) -> object:
    """Sets ``items`` (key, value, key, ...). Other keys than strings become ``OTHER``: hashing them may be slow."""
    if isinstance(target, dict):
        for key, value in zip(items[::2], items[1::2], strict=True):
            target[key if isinstance(key, str) else OTHER] = value
    return target


def _instead_of_call(called: object, arguments: object) -> object:
    """Substitute for the result of a call: a tensor or a dictionary for known constructors, else ``OTHER``."""
    if not isinstance(called, _Name) or not isinstance(arguments, tuple):
        return OTHER
    if called.path == "collections.OrderedDict" and not arguments:
        return {}
    if called.path == "torch._utils._rebuild_tensor_v2":
        return _stored_tensor(arguments)
    if called.path in ("torch._utils._rebuild_parameter", "torch._utils._rebuild_parameter_with_state"):
        return arguments[0] if arguments and isinstance(arguments[0], StoredTensor) else OTHER
    return OTHER


def _stored_values(reference: object) -> StoredValues:
    """('storage', class, entry, device, count) as ``torch.save`` writes them."""
    match reference:
        case ("storage", _Name(kind), str(entry), str(), int(count)) if count >= 0:
            return StoredValues(kind, entry, count)
    raise ValueError("a reference to values that torch.save does not write")


def _stored_tensor(arguments: tuple[Any, ...]) -> StoredTensor:
    """(values, offset, shape, stride, ...); refuses tensors that reach outside their storage, or repeat its values.

    Repeated values (stride 0) would let a small file request any amount of memory.
    """
    match arguments:
        case (StoredValues() as values, int(offset), tuple(shape), tuple(stride), *_):
            pass
        case _:
            raise ValueError("a tensor that torch.save does not write")
    if len(shape) != len(stride) or any(type(n) is not int or n < 0 for n in (offset, *shape, *stride)):
        raise ValueError("a tensor with an impossible shape")
    count = 1
    for n in shape:
        count *= n
        # Python integers do not overflow, but grow: stop before many dimensions make them slow.
        if count > 2**62:
            raise ValueError("a tensor with an impossible shape")
    # Strides are not negative, so the last element has the largest index.
    last = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True))
    if count and (last >= values.count or count > values.count):
        raise ValueError(f"a tensor larger than its {values.count} stored values")
    return StoredTensor(values, offset, shape, stride)
