"""Names of kinds of versions."""

STUDY = "population"  # results of a study of many takes
RELEASE = "release"  # one version of every take under a name
CALIBRATION = "calibration"  # of the lights of a dome
# tables, samples or maps of a take with other parameters than those of its model
SUMMARY = "summary"
# whose takes are names of studies, releases and calibrations
KINDS_WITHOUT_SUBJECT = (STUDY, RELEASE, CALIBRATION)
# kinds that hold data of their own subject only; an input of them is of that subject,
# or a product that many share
KINDS_OF_ONE_SUBJECT = ("capture", "first", "model", "consent")
