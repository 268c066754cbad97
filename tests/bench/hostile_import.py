"""A method whose module replaces the scorer when it is imported."""

from hostile_methods import Hostile, _replace_the_scorer

_replace_the_scorer()


class ReplacesAtImport(Hostile):
    pass
