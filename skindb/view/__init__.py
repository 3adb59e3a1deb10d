"""Pages for the browser: a viewer in which a fitted face is lit, turned and edited, and
an editor of landmarks.
"""
