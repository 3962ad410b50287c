"""The commands ``uavlinkd evaluate NAME``: arguments in, exit status out. Large modules are imported when one runs.

Exit status 0: the results are as expected. 1: otherwise; standard error has the reasons. The last line of standard
output is one JSON object with the results.
"""

from __future__ import annotations

import argparse
import asyncio
import importlib
import json
import sys
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

if TYPE_CHECKING:
    from uavlinkd.lab.evaluation.frame import Evaluation

OK, FAILED = 0, 1
EVALUATIONS = {
    "timing": "time the paper's method and uavlinkd's",
    "tampering": "attack the paper's protocol and real daemons",
    "flight": "let two aircraft exchange positions in flight under attack",
}
STAGES = ("handshake", "data", "keys", "paper", "paths", "line", "relay", "web", "fleet")

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def add_evaluations(commands: _Commands) -> None:
    """Add the evaluations."""
    _, tampering, _ = (_add(commands, name) for name in EVALUATIONS)
    tampering.add_argument(
        "--only",
        metavar="STAGE",
        choices=STAGES,
        action="append",
        help=f"run this stage alone; may be repeated: {', '.join(STAGES)} (default: all)",
    )


def _add(commands: _Commands, name: str) -> argparse.ArgumentParser:
    text = EVALUATIONS[name]
    parser = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
    parser.add_argument("--out", metavar="DIR", type=Path, required=True, help="folder for the results")
    parser.add_argument("--quick", action="store_true", help="a part of it: about a minute")
    parser.add_argument(
        "--seed", metavar="N", type=int, default=0, help="seed of the choices, not of keys (default: %(default)s)"
    )
    parser.set_defaults(command=_evaluate, evaluation=name)
    return parser


def evaluation_of(name: str) -> Evaluation[Any, Any]:
    module = importlib.import_module(f"uavlinkd.lab.evaluation.{name}_run")
    evaluation: Evaluation[Any, Any] = getattr(module, name.upper())
    return evaluation


def settings_of(evaluation: Evaluation[Any, Any], options: argparse.Namespace) -> Any:
    values = {item.name: getattr(options, item.name) for item in fields(evaluation.settings)}
    if "only" in values:
        values["only"] = tuple(values["only"] or ())
    return evaluation.settings(**values)


def _evaluate(options: argparse.Namespace) -> int:
    evaluation = evaluation_of(options.evaluation)
    try:
        asyncio.run(evaluation.measure(options.out, settings_of(evaluation, options), _show))
        print(evaluation.write(options.out))
        findings = evaluation.read(options.out)
    except _errors() as error:
        return _fail(error)
    problems = evaluation.deviations(findings)
    for line in problems:
        print(line, file=sys.stderr)
    print(json.dumps(evaluation.summary(findings)))
    return FAILED if problems else OK


def _errors() -> tuple[type[Exception], ...]:
    """What a run may raise; the message is for the operator."""
    from uavlinkd.lab.evaluation.records import EvaluationError  # noqa: PLC0415
    from uavlinkd.lab.sim.drone_process import DroneError  # noqa: PLC0415
    from uavlinkd.ops.control import ControlError  # noqa: PLC0415

    return (EvaluationError, DroneError, ControlError, OSError)


def _show(line: str) -> None:
    print(line, flush=True)


def _fail(problem: object) -> int:
    print(problem, file=sys.stderr)
    return FAILED
