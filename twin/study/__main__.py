"""`python -m terrafusion.twin.study`."""

from terrafusion.twin.study.table import main

main()
