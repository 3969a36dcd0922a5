"""Names that a module offers and imports on first use, so that importing it loads nothing slow."""

import ast
from pathlib import Path


def offered_names(file: str) -> dict[str, str]:
    """Return each name that a module offers, with the module to import it from.

    They are the imports under `if TYPE_CHECKING:`, so that type checkers and `import` read one
    list. A wheel's build rewrites them together with all other imports (infra/setup/wheel_tree.py).

    Args:
        file: the module's `__file__`.
    """
    tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    return {
        alias.name: str(statement.module)
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }
