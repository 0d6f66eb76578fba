"""How this package refuses: one sentence, with the value and the mend."""

from typing import Any

import pytest

from sumajax.description import CheckpointError


def refusal(call: Any, *args: Any, **kwargs: Any) -> str:
    """The one sentence with which `call` refuses."""
    with pytest.raises(CheckpointError) as caught:
        call(*args, **kwargs)
    sentence = str(caught.value)
    assert sentence.endswith(".")
    assert "\n" not in sentence
    assert ";" in sentence or ", got" in sentence or ":" in sentence, "what is the mend?"
    return sentence
