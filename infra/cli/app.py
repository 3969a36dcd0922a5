"""The command `trilight`: one file per subcommand, one way to report a mistake."""

import os
import signal
import sys
from types import FrameType
from typing import NoReturn

import typer

from infra.cli import (
    assets,
    bench,
    convert,
    doctor,
    evaluate,
    generate,
    inspect,
    model,
    plan,
    render,
    shards,
    status,
    train,
    verify,
)
from infra.cli.console import console
from storage.errors import TrilightError

app = typer.Typer(
    name="trilight",
    help="Triangles in, light out: make data for, train and judge RenderFormer-style renderers.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command("doctor")(doctor.doctor)
app.command("assets")(assets.assets)
app.command("generate")(generate.generate)
app.command("plan")(plan.plan)
app.command("render")(render.render)
app.command("convert")(convert.convert)
app.command("verify")(verify.verify)
app.command("inspect")(inspect.inspect)
app.command("model")(model.model)
app.command("status")(status.status)
app.command("train")(train.train)
app.command("evaluate")(evaluate.evaluate)
app.command("bench")(bench.bench)
app.add_typer(shards.app, name="shards")


def main() -> None:
    """Run the command line; a mistake of the user is one line on stderr and exit status 1."""
    # torch's threads would wait for each other in busy loops, which beside other work made training
    # twelve times slower; read when torch is imported, and a setting of the user's own wins
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    signal.signal(signal.SIGINT, _interrupted)
    try:
        app()
    except TrilightError as mistake:
        _leave(f"trilight: {mistake}", 1)


def _interrupted(signal_number: int, frame: FrameType | None) -> None:
    console.show_cursor()  # progress bars hide it, and nothing is unwound
    _leave("trilight: interrupted. What was finished is safe; the same command goes on.", 130)


def _leave(message: str, status: int) -> NoReturn:
    """End at once: every child ends with its parent, and every file is whole or absent."""
    sys.stdout.flush()
    errors = sys.__stderr__ or sys.stderr  # progress bars would draw themselves again below it
    errors.write(f"\n{message}\n")
    errors.flush()
    os._exit(status)


if __name__ == "__main__":
    main()
