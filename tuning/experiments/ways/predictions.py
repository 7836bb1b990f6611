"""What the authors of the ways, and we, would predict of the study; written before its first run."""

from __future__ import annotations

from typing import NamedTuple


class Prediction(NamedTuple):
    """A statement that the study can contradict."""

    who: str
    says: str


PREDICTIONS = (
    Prediction("Greenberg et al. (OKF)", "Adam on the error beats noise estimation wherever the model is wrong."),
    Prediction("Abbeel et al.", "The log score beats likelihood and noise estimation on real error."),
    Prediction("Chen et al.", "A consistent NIS finds Q and R, and no local minimum holds it."),
    Prediction("Rawlings et al.", "ALS equals maximum likelihood on long runs of a linear model."),
    Prediction("Dunik et al.", "Likelihood is the most accurate, correlation methods 10 to 100 times faster."),
    Prediction("Durbin, Koopman", "Maximum likelihood is efficient where the model is right."),
    Prediction("Shumway, Stoffer", "EM ends where maximum likelihood ends, slowly."),
    Prediction("Sarkka, Nummenmaa", "A converged adaptive filter loses 1 to 3 % on constant noise."),
    Prediction(
        "Desroziers et al.", "Innovations tell R and a factor on Q within 2 % of the best, without a search."
    ),
    Prediction("The MathWorks", "A step up or half of it, a number at a time, is enough."),
    Prediction("we", "A model that is right: noise estimation is best and free."),
    Prediction(
        "we", "A model that is right, one to three runs: likelihood beats tuning on truth of the same runs."
    ),
    Prediction("we", "From ten numbers on, gradients beat samplers by 5 % in a tenth of the time."),
    Prediction("we", "The log score is within 2 % of the least error, with a NEES near 1, everywhere."),
    Prediction("we", "Ways without truth lose less than 5 % but on wrong models."),
    Prediction("we", "Random search within 1e4 runs is beaten by every search but coordinate steps."),
)
