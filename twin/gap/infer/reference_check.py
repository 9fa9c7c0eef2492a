"""Laws that act beyond a threshold, and that references do not rule out.

References that never meet a motor limit tell nothing of it, so the robot's may be another than the twin's all
along. Where the judged runs meet it, because of another change, it explains a part of the gap without having
changed itself.
"""

import dataclasses

import numpy as np

from terrafusion.twin.gap.data.candidates import Hypothesis
from terrafusion.twin.gap.infer.bank import INSENSITIVE, SignatureBank, SimulatedSize, model_soil
from terrafusion.twin.gap.null.evidence import GapEvidence

PRESENT = 0.25
"""Share of a law, by least squares, from which references hold it (assumed, with one robot of another
simulator in view): none of one that changed, all of one that the robot always had, if the twin knew its size
and all else."""


@dataclasses.dataclass(eq=False)
class ReferenceCheck:
    """Asks references of laws in a bank, each law and size once."""

    bank: SignatureBank
    evidence: GapEvidence
    known: dict[tuple[Hypothesis, float], bool] = dataclasses.field(default_factory=dict)

    def may_be_old(self, law: Hypothesis, size: float) -> bool:
        """Whether the references may hold an insensitive law at about a size, in typical ones."""
        if law not in self.bank.signatures or not self.evidence.references:
            return False
        sizes = self.bank.sizes(law)
        near = float(min(sizes[sizes != 0.0], key=lambda x: abs(x - size)))
        if (law, near) not in self.known:
            self.known[law, near] = not self._sensitive(law) and not self._ruled_out(law, near)
        return self.known[law, near]

    def _sensitive(self, law: Hypothesis) -> bool:
        """Whether the robot's offsets hold what references know of the law."""
        if self.evidence.candidates.is_composite(law):
            return True
        slopes = [run.by_parameter[:, law.columns].sum(axis=1) for run in self.evidence.references]
        most = np.abs(self.evidence.candidates.bounds(law.columns)).max()
        return sum(float(np.square(most * slope).sum()) for slope in slopes) >= INSENSITIVE

    def _ruled_out(self, law: Hypothesis, size: float) -> bool:
        references = dataclasses.replace(self.evidence, runs=self.evidence.references)
        points = [SimulatedSize(law, size, model_soil(references))]
        found = SignatureBank.empty(references).with_sizes(references, points).signatures
        if law not in found:  # the twin diverges on one of them
            return True
        pairs = zip(found[law][size], references.runs, strict=True)
        square, inner = np.sum([(own @ own, own @ run.error) for own, run in pairs], axis=0)
        return bool(square >= INSENSITIVE and inner < PRESENT * square)
