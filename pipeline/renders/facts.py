"""What the render stage runs on, for people and for logs; asked in a process of its own."""

import json
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from pipeline.renders.denoiser import open_device
from pipeline.renders.variant import Variant, activate
from storage.installation import IMPORT_ROOT, child_environment

_ASK_S = 120


def render_facts(variant: Variant) -> dict[str, str]:
    """Return versions, device and threads by name; what cannot be asked is left out."""
    facts = {name: metadata.version(name) for name in ("mitsuba", "drjit", "pyoidn")}
    facts |= {"variant": variant.name, "llvm": Path(variant.libllvm).name}
    result = subprocess.run(
        [sys.executable, "-m", f"{__package__}.facts", json.dumps(vars(variant))],
        cwd=IMPORT_ROOT,
        env=child_environment(),
        capture_output=True,
        text=True,
        timeout=_ASK_S,
        check=False,
    )
    return facts | json.loads(result.stdout) if result.returncode == 0 else facts


def _answer(variant: Variant) -> dict[str, str]:
    activate(variant)
    import drjit

    version = open_device(variant.denoiser).get_int("version")
    return {
        "threads": str(drjit.thread_count()),
        "denoiser": f"{version // 10000}.{version // 100 % 100}.{version % 100}",
        "denoiser_device": variant.denoiser,
    }


if __name__ == "__main__":
    sys.stdout.write(json.dumps(_answer(Variant(**json.loads(sys.argv[1])))))
