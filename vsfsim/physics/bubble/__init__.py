"""The air-filled bubble sensor: membrane, gas, inflation."""
