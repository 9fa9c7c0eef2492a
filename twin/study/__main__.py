"""`python -m terrafusion.twin.study`: the study's tables beside the twin's, as text."""

import argparse

from terrafusion.twin.study.study import StudyPlan, run_study
from terrafusion.twin.study.text import study_lines

parser = argparse.ArgumentParser(
    prog="python -m terrafusion.twin.study",
    description="The study's tables beside the twin's, as text; `terrafusion study` also writes them.",
)
parser.parse_args()
print("\n".join(study_lines(run_study(StudyPlan()))))
