"""Integers only: gates on the LLVM module of a step.

A step passes if it has no float and no vector of floats, allocates nothing and calls nothing
outside itself, returns in one way only (no exception), and, by LLVM's own inference, touches
nothing but its arguments and only reads those it must.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import llvmlite.binding as llvm

from ato_hil.tools.verify.native import Native

# Written as LLVM writes types; a name in quotes may hold anything.
FLOAT = re.compile(r"\b(half|bfloat|float|double|x86_fp80|fp128|ppc_fp128)\b")
QUOTED = re.compile(r'"[^"]*"')
NAMED = re.compile(r"[@%][\w.$-]+")
# llvm.mem*: become calls of memset and memcpy, which every target has.
INTRINSIC = re.compile(
    r"llvm\.([su](max|min|cmp|(add|sub|shl)\.(sat|with\.overflow))|abs|ctlz|cttz|ctpop|fsh[lr]|bswap"
    r"|mem(set|cpy|move)|assume|lifetime|vector\.reduce\.[a-z]+|experimental\.noalias\.scope\.decl)\b"
)
PROMISES = ("nofree", "norecurse", "nosync", "nounwind")


def findings(native: Native, read_only: tuple[str, ...] = ()) -> list[str]:
    """What breaks a gate, one entry each, empty if all hold. `read_only`: arguments that the step
    may not write."""
    module = llvm.parse_assembly(native.ir)
    found = []
    for function in module.functions:
        if function.is_declaration:
            if not INTRINSIC.match(function.name):
                found.append(f"calls {function.name}")
            continue
        for block in function.blocks:
            for instruction in block.instructions:
                found += _instruction(instruction)
    entry = module.get_function(native.symbol)
    found += _promises(native.ir, native.symbol)
    found += [f"may write {name}" for name in read_only if not _is_read_only(entry, name)]
    return sorted(set(found))


def _instruction(instruction: llvm.ValueRef) -> Iterator[str]:
    text = NAMED.sub("", QUOTED.sub("", str(instruction).split(", !")[0])).strip()
    opcode = instruction.opcode
    if FLOAT.search(text):
        yield f"float: {text}"
    if opcode in ("invoke", "resume", "landingpad", "unreachable", "indirectbr"):
        yield f"exception path: {text}"
    if opcode == "ret" and text not in ("ret i32 0", "ret void"):
        yield f"may return a failure: {text}"
    if opcode == "alloca" and " x " not in text and re.search(r", i\d+ \S*$", text):
        yield f"variable stack: {text}"
    if opcode == "call" and re.search(r"\basm\b", text):
        yield f"assembler: {text}"


def _attributes(ir: str, symbol: str) -> str:
    """The attribute group of a function, as text."""
    start = re.compile(rf'define .*@"?{re.escape(symbol)}"?\(')
    head = next(line for line in ir.splitlines() if start.match(line))
    group = re.search(r"(#\d+)(?: \{| )", head[head.rindex(")") :])
    if group is None:
        return ""
    return next((x for x in ir.splitlines() if x.startswith(f"attributes {group[1]} ")), "")


def _promises(ir: str, symbol: str) -> list[str]:
    """What LLVM could not infer of the promises that a step keeps."""
    attributes = _attributes(ir, symbol)
    found = [f"not proved {name}" for name in PROMISES if not re.search(rf"\b{name}\b", attributes)]
    memory = re.search(r"memory\((.*?)\)(?= |$)", attributes)
    if memory is None or not re.fullmatch(r"none|argmem: (read|write|readwrite)", memory[1]):
        found.append(f"touches more than its arguments: memory({memory[1] if memory else 'any'})")
    return found


def _is_read_only(function: llvm.ValueRef, name: str) -> bool:
    for argument in function.arguments:
        if argument.name in (f"arg.{name}", f"arg.{name}.4"):  # a record; data pointer of an array
            return bool(re.search(r"\b(readonly|readnone)\b", str(b" ".join(argument.attributes))))
    return False  # there is no such argument
