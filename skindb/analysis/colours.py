"""Colours of plots that colour-blind readers can distinguish (Okabe and Ito 2008)."""

BLUE, ORANGE, GREEN, RED, PURPLE, SKY, YELLOW = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#cc79a7",
    "#56b4e9",
    "#f0e442",
)
CYCLE = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY)
CHANNELS = (RED, GREEN, BLUE)  # of the camera
