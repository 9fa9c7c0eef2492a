"""`python -m terrafusion.twin.study`: the study's tables beside the twin's, as text."""

from terrafusion.twin.study.study import StudyPlan, run_study
from terrafusion.twin.study.text import study_lines

print("\n".join(study_lines(run_study(StudyPlan()))))
