"""Whether an error names an argument."""

import re

_NAMES = (
    "params|params_per_run|measurements?|prior|t0|times|key|clock|time|value|sensor|mask|arrival|"
    "truth|tau|window|model|estimator|context|context_per_run|weight|devices|metric|method|block|"
    "F|Q|H|R|b|q|r|dt|lag|size|fading|form|unused"
)
_FIRST = re.compile(rf"^({_NAMES})([.\[][\w.'\[\]\"]*)?: (?=\S)")


def is_named(text: str) -> bool:
    """Whether the text of an error begins with the name of an argument and a colon."""
    return _FIRST.match(text) is not None
