"""Forms (to come)."""

from terrafusion.twin.effects.form import Form

FORMS: tuple[Form, ...] = ()
