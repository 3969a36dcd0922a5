"""Lazy exports of a module, so that importing it loads nothing slow."""

import ast
from pathlib import Path


def offered_names(file: str) -> dict[str, tuple[str, str]]:
    """Return the place of each exported name of a module: another module, and the name there.

    The exports are the imports under `if TYPE_CHECKING:`, so that type checkers and `import` read
    one list; `import join as joined` exports `joined`. The wheel's build rewrites them with all
    other imports (infra/setup/build_backend.py).

    Args:
        file: the module's `__file__`.
    """
    tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.asname or alias.name: (str(statement.module), alias.name)
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
