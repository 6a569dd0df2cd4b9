"""The colours of everything that is drawn: the same thing has the same colour everywhere.

They can be told apart with the common kinds of colour blindness, on black and on white.
"""

from __future__ import annotations

Colour = tuple[int, int, int]  # red, green, blue, 0..255

BLUE: Colour = (86, 180, 233)
ORANGE: Colour = (240, 160, 40)
RED: Colour = (225, 75, 60)
PINK: Colour = (220, 140, 180)
GREEN: Colour = (40, 180, 130)
YELLOW: Colour = (240, 228, 66)
GREY: Colour = (150, 150, 150)
VIOLET: Colour = (150, 120, 220)
BROWN: Colour = (165, 110, 70)

MEASURED, COMMANDED, REFERENCE, TRUE = BLUE, BLUE, ORANGE, GREEN
PERMITTED, TARGET = RED, PINK
AHEAD, BEHIND = GREEN, VIOLET

# From the first run to the last, or from the leading train to the last: the eye sees learning as a
# change of colour.
RAMP: tuple[Colour, ...] = (VIOLET, RED, ORANGE, YELLOW)

# For what has no order: cars, messages, sessions.
APART: tuple[Colour, ...] = (GREY, BLUE, GREEN, YELLOW, ORANGE, RED, PINK, VIOLET)

STATES: dict[str, Colour] = {
    "normal": GREEN,
    "good": GREEN,
    "none": GREEN,
    "ok": GREEN,
    "running": GREEN,
    "traction": BLUE,
    "coast": GREY,
    "brake": ORANGE,
    "hold": VIOLET,
    "warning": YELLOW,
    "degraded": YELLOW,
    "repeated": YELLOW,
    "lost": ORANGE,
    "service_brake": ORANGE,
    "emergency_brake": RED,
    "emergency_request": RED,
    "invalid": RED,
    "corrupt": RED,
}


def ramp(fraction: float) -> Colour:
    """Colour of a run or a train, 0 for the first and 1 for the last."""
    place = min(max(fraction, 0.0), 1.0) * (len(RAMP) - 1)
    below = min(int(place), len(RAMP) - 2)
    first, second = RAMP[below], RAMP[below + 1]
    red, green, blue = (
        round(a + (b - a) * (place - below)) for a, b in zip(first, second, strict=True)
    )
    return red, green, blue


def apart(number: int) -> Colour:
    """Colour of one of several things without order; darker after each round of colours."""
    rounds, place = divmod(number + 1, len(APART))
    red, green, blue = (round(part * 0.6**rounds) for part in APART[place])
    return red, green, blue
