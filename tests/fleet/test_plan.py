"""Templates contain a member's number and name, and give no access to anything else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from uavlinkd.fleet.manifest import FleetError, FleetSettings, check_settings, fill, planned_address


@pytest.mark.parametrize(
    ("template", "text"),
    [("", ""), ("10.13.0.{n}:5790", "10.13.0.7:5790"), ("{name}.local:{n}{n}", "{n}.local:77"), ("%s {n}", "%s 7")],
)
def test_number_and_name_are_put_in(template: str, text: str) -> None:
    """``{n}`` and ``{name}`` are replaced. Other text is kept, and braces in a name too."""
    assert fill(template, 7, "{n}") == text


@pytest.mark.parametrize(
    "template",
    [
        *("{name.__class__}", "{name.__class__.__mro__}", "{n.real}", "{0}", "{}", "{name!r}", "{n:>9999999}"),
        *("{name[0]}", "{ n }", "{N}", "{{n}}", "{n", "n}"),
    ],
)
def test_anything_else_in_braces_is_refused(template: str) -> None:
    """Attributes, items, positions, conversions, widths and unpaired braces; the error names the option."""
    with pytest.raises(FleetError, match=r"\{n\} and \{name\}"):
        fill(template, 7, "scout")
    with pytest.raises(FleetError, match="address plan"):
        planned_address(f"{{name}}{template}:5790", "scout", 7, is_drone=True)
    for key in ("control_socket", "drone_url", "ground_station_url"):
        settings: dict[str, str] = {key: f"/run/{template}"}
        with pytest.raises(FleetError, match=f"--{key.replace('_', '-')}"):
            check_settings(replace(FleetSettings(), **settings))  # type: ignore[arg-type]
