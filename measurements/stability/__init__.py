"""The stability map: presses at the extremes of every quantity of a scene, each judged by checks that do not trust the
solver."""
