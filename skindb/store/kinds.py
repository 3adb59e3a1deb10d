"""Kinds of versions that belong to no take."""

STUDY = "population"  # results about all takes
RELEASE = "release"  # which version of every take a name stands for
CALIBRATION = "calibration"  # of the lights of a dome
SUMMARY = "summary"  # other tables, samples or maps of a take than its model and registration keep
