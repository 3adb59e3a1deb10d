"""Names of kinds of versions."""

STUDY = "population"  # results of a study of many takes
RELEASE = "release"  # one version of every take under a name
CALIBRATION = "calibration"  # of the lights of a dome
SUMMARY = "summary"  # tables, samples or maps of a take with other parameters than those of its model
