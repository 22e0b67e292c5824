"""The rules that no reviewer should have to check: style, types, layers, short functions, a quick and quiet start."""

import ast
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "uavkit"
MODULES = sorted(PACKAGE.rglob("*.py"))
LONGEST_FUNCTION = 60
LONGEST_KERNEL = 120
"""Inner loops are compiled as one piece; splitting them costs speed, so they may be longer."""
HEAVY = ("numba", "cv2", "scipy", "av", "matplotlib", "pyproj", "laspy", "PIL", "pydantic", "numpy")
SLOWEST_HELP_S = 0.3


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a tool of the interpreter's own environment in the root of the project."""
    paths = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    environment = {**os.environ, "PATH": paths, "PYTHONPATH": str(ROOT), "NO_COLOR": "1"}
    return subprocess.run(arguments, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    "tool",
    [
        (sys.executable, "-m", "ruff", "check", "."),
        (sys.executable, "-m", "ruff", "format", "--check", "."),
        (sys.executable, "-m", "mypy"),
        (str(Path(sys.executable).with_name("lint-imports")),),
    ],
    ids=["ruff check", "ruff format", "mypy", "lint-imports"],
)
def test_a_tool_has_nothing_to_say(tool: tuple[str, ...]) -> None:
    finished = run(*tool)
    assert finished.returncode == 0, finished.stdout + finished.stderr


def functions(path: Path) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Count the lines of a function without its docstring."""
    total = (function.end_lineno or function.lineno) - function.lineno + 1
    first = function.body[0]
    if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str):
        total -= (first.end_lineno or first.lineno) - first.lineno + 1
    return total


def is_kernel(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    return any(isinstance(mark, ast.Name) and mark.id == "kernel" for mark in function.decorator_list)


def test_functions_are_short() -> None:
    long = [
        f"{path.relative_to(ROOT)}:{function.lineno}: {function.name} has {lines(function)} lines"
        for path in MODULES
        for function in functions(path)
        if lines(function) > (LONGEST_KERNEL if is_kernel(function) else LONGEST_FUNCTION)
    ]
    assert not long, "\n".join(long)


def test_public_functions_and_classes_have_a_docstring() -> None:
    bare = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {node.name}"
        for path in MODULES
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and not node.name.startswith("_")
        and ast.get_docstring(node) is None
    ]
    assert not bare, "\n".join(bare)


def called_names(path: Path) -> Iterator[tuple[int, str]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            yield node.lineno, node.func.id


def test_the_library_does_not_print() -> None:
    """Results are returned, progress goes to a callable; only the command line speaks, and it has its own console."""
    prints = [
        f"{path.relative_to(ROOT)}:{line}" for path in MODULES for line, name in called_names(path) if name == "print"
    ]
    assert not prints, "\n".join(prints)


def catches_everything(path: Path) -> bool:
    handlers = (node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Try))
    caught = (handler.type for block in handlers for handler in block.handlers)
    return any(kind is None or (isinstance(kind, ast.Name) and kind.id == "Exception") for kind in caught)


def test_only_the_command_line_catches_everything() -> None:
    guilty = [str(path.relative_to(ROOT)) for path in MODULES if catches_everything(path) and path.name != "cli.py"]
    assert not guilty


def test_test_files_have_names_of_their_own() -> None:
    """pytest imports test files by their bare name: two of the same name would hide one another."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))


def processor_time_s() -> float:
    """Return what all finished child processes have used so far."""
    used = os.times()
    return used.children_user + used.children_system


def test_help_answers_at_once() -> None:
    """The processor's time, the least of several runs: the machine may be busy with something else."""
    times_s = []
    for _ in range(7):
        start = processor_time_s()
        assert run(sys.executable, "-m", "uavkit.cli", "--help").returncode == 0
        times_s.append(processor_time_s() - start)
    assert 0.0 < min(times_s) < SLOWEST_HELP_S


def test_help_imports_nothing_heavy() -> None:
    script = (
        "import sys\n"
        "from uavkit.cli import main\n"
        "sys.argv = ['uavkit', '--help']\n"
        "try:\n"
        "    main()\n"
        "except SystemExit as end:\n"
        "    assert not end.code, end.code\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules])\n"
    )
    finished = run(sys.executable, "-c", script)
    assert finished.returncode == 0, finished.stderr
    assert finished.stdout.splitlines()[-1] == "[]"
