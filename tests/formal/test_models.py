"""The symbolic models have the results that their files expect, if ProVerif is installed."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from tests.formal import models
from uavlinkd.protocol import noise
from uavlinkd.protocol.suites import SUITES_BY_NAME, Suite

_LIMIT_S = float(os.environ.get("PROVERIF_LIMIT_S", models.LIMIT_S))

_each_model = pytest.mark.parametrize("model", models.models(), ids=lambda model: model.stem)


@_each_model
def test_proverif_returns_the_expected_results(model: Path) -> None:
    """Each query has exactly the result in the comment above it: true is proved, false comes with an attack."""
    executable = models.proverif()
    if executable is None:  # in CI too: neither Debian nor PyPI has it, so .ci/run cannot bring it
        pytest.skip("no ProVerif: put proverif on the PATH, or its path into PROVERIF")
    done = models.run(model, executable, _LIMIT_S)
    assert done.results == models.expected(model), "\n".join(done.lines)


def test_every_query_states_its_result() -> None:
    """Every query has an expected result, so that none can change unnoticed."""
    for model in models.models():
        queries = re.findall(r"^query\b", model.read_text(), re.MULTILINE)
        assert 0 < len(queries) == len(models.expected(model)), model


def test_models_use_ingredients_that_exist() -> None:
    """A misspelt ingredient would silently omit what it names."""
    for model in models.models():
        uses = models.ingredients(model)
        assert uses is None or (uses and uses <= models.known_ingredients()), model


def test_ingredients_that_prevent_an_attack_are_in_every_other_model() -> None:
    """No other model omits what the models ``without_*`` omit one at a time."""
    needed = {"es", "ee", "se", "ss", "indices", "confirmation"}
    for model in models.models():
        uses = models.ingredients(model)
        if uses is not None:
            assert needed - uses == {model.stem.removeprefix("without_")} & needed


_TOKEN_OF = {
    "bytes(E)": "e",
    "bytes(R)": "e",
    "dh_initiator(e, B)": "es",
    "dh_initiator(a, B)": "ss",
    "dh_initiator(e, R)": "ee",
    "dh_initiator(a, R)": "se",
    "dh_responder(b, E)": "es",
    "dh_responder(b, A)": "ss",
    "dh_responder(r, E)": "ee",
    "dh_responder(r, A)": "se",
    "decapsulate(d, sealed)": "ekem1",
    "kem_secret(s, z)": "ekem1",
    "psk": "psk",
}


@pytest.mark.parametrize("role", ["Initiator", "Responder"])
@pytest.mark.parametrize(
    "suite", [SUITES_BY_NAME[name] for name in ("x25519", "mlkem768")], ids=lambda suite: suite.name
)
def test_model_mixes_keys_in_the_order_of_the_code(suite: Suite, role: str) -> None:
    """Both roles of the model mix the inputs of the code's pattern into the chaining key, in its order."""
    kem = {"kem"} if suite.has_group else set()
    text = models.select(frozenset({"es", "ss", "ee", "se"} | kem))
    body = text[text.index(f"let {role}(") :].partition("split_1")[0]
    in_model, result_of = [], ""
    for name, value in re.findall(r"let (x|ck) = (.*) in$", body, re.MULTILINE):
        if name == "x":
            result_of = value
        elif mixed := re.fullmatch(r"hkdf3?_ck\(ck, (.*)\)", value):
            in_model.append(_TOKEN_OF[result_of if mixed[1] == "x" else mixed[1]])
    silent = {"s", "e1"}  # these put nothing into the chaining key
    assert in_model == [token for tokens in noise.tokens_of(suite) for token in tokens if token not in silent]


def test_no_ingredient_is_left_in_a_comment() -> None:
    """Every marked line is either included or not: no mark is misread as a plain comment."""
    for line in models.PROTOCOL.read_text().splitlines():
        assert ("(*+" in line or "(*-" in line) == bool(re.match(r"\(\*[+-]\w+\*\) ", line)), line
