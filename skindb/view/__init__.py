"""Pages in a browser: one in which a fitted face is lit, turned and edited, one that sets landmarks on a scan."""
