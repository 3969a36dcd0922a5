"""`trilight revisit`: makes a new dataset from the scenes of a finished one."""

from infra.cli.console import first_words
from infra.cli.generate import ExecutorOptions, make
from infra.cli.options import command
from infra.cli.overrides import BaseSettings, with_base_settings
from pipeline.generation.revisit_options import RevisitOptions, to_generate_options


@command("dataset")
def revisit(options: RevisitOptions, runner: ExecutorOptions) -> None:
    first_words(f"Reading {options.dataset}")
    made = with_base_settings(to_generate_options(options), BaseSettings(like=options.dataset))
    make(made, runner)
