"""Messages that name the nearest allowed word."""

from vsfsim.core.errors import SceneError, VsfsimError, did_you_mean, unknown_key


def test_the_nearest_word_and_all_of_them():
    assert did_you_mean("fine", ["fem", "fem-fine"]) == "Did you mean 'fem-fine'? Allowed: fem, fem-fine."
    assert did_you_mean("xyz", ["b", "a"]) == "Allowed: a, b."
    assert did_you_mean("xyz", []) == "Allowed: (none)."


def test_an_unknown_key_says_where():
    assert unknown_key("s.toml [press]", "form",
                       ["from", "to"]) == "s.toml [press]: unknown key 'form'. Did you mean 'from'? Allowed: from, to."
    assert issubclass(SceneError, VsfsimError) and not issubclass(VsfsimError, ValueError)
