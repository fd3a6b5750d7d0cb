"""`flytune rules`."""

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from flytune.cli.options import AsJson

RulesFile = Annotated[
    Path | None, Parameter(name="--rules", metavar="FILE.toml", help="your own rules, beside those of flytune")
]


def rules(*, rules_file: RulesFile = None, as_json: AsJson = False) -> None:
    """Print the heuristics of the tuner as a table."""
    from flytune.tuning.rules import load_rules, rules_table, to_dicts

    rules = load_rules(rules_file)
    print(json.dumps({"schema": 1, "rules": to_dicts(rules)}) if as_json else rules_table(rules))
