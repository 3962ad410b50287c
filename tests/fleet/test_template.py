"""Templates contain a member's number and name, and give no access to anything else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from uavlinkd.fleet.errors import FleetError
from uavlinkd.fleet.manifest import Fleet, FleetSettings, MemberKind, check_settings
from uavlinkd.fleet.plan import AddressPlan
from uavlinkd.fleet.template import TemplateError, fill

OTHERS = [
    *("{name.__class__}", "{name.__class__.__mro__}", "{n.real}", "{0}", "{}", "{name!r}", "{n:>9999999}"),
    *("{name[0]}", "{ n }", "{N}", "{{n}}", "{n", "n}"),
]


@pytest.mark.parametrize(
    ("template", "text"),
    [
        ("", ""),
        ("plain", "plain"),
        ("10.13.0.{n}:5790", "10.13.0.7:5790"),
        ("{name}.local:{n}{n}", "scout.local:77"),
        ("%s {n}", "%s 7"),
    ],
)
def test_number_and_name_are_put_in(template: str, text: str) -> None:
    """``{n}`` and ``{name}`` are replaced, and other text is kept."""
    assert fill(template, 7, "scout") == text


def test_value_is_not_filled_again() -> None:
    """Braces in a name are kept."""
    assert fill("{name}{n}", 7, "{n}") == "{n}7"


@pytest.mark.parametrize("template", OTHERS)
def test_anything_else_in_braces_is_refused(template: str) -> None:
    """Attributes, items, positions, conversions, widths and unpaired braces."""
    with pytest.raises(TemplateError, match=r"\{n\} and \{name\}"):
        fill(template, 7, "scout")


@pytest.mark.parametrize("key", ["control_socket", "drone_url", "ground_station_url", "observer_url"])
@pytest.mark.parametrize("template", OTHERS)
def test_settings_are_refused_before_a_member_is_made(key: str, template: str) -> None:
    """The error names the option, also if there is no member of that kind yet."""
    with pytest.raises(FleetError, match=f"--{key.replace('_', '-')}"):
        check_settings(replace(FleetSettings(), **{key: f"/run/{template}"}))  # type: ignore[arg-type]


@pytest.mark.parametrize("template", OTHERS)
def test_address_plan_takes_no_more(template: str) -> None:
    """Address plans follow the same rule."""
    with pytest.raises(FleetError, match="address plan"):
        AddressPlan.parse(f"{{name}}{template}:5790")


def test_control_socket_may_have_both() -> None:
    """``--control-socket`` may contain number and name."""
    settings = FleetSettings(control_socket="/run/{name}-{n}.sock")
    member = Fleet(settings).new_member("scout", MemberKind.DRONE, "key")
    assert settings.control_socket_of(member) == "/run/scout-1.sock"
