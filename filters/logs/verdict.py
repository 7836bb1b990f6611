"""The results of a filter's run over a log, in words."""

from __future__ import annotations

from math import isnan

from filters.consistency.blow_up import blow_up_sentence
from filters.logs.estimate import LogEstimate
from filters.logs.findings import LogFindings
from thruster_env.logs.findings import GAP, SPOILING, sentences

ALPHA = 0.05  # below which a p-value speaks against white innovations


def verdict(found: LogEstimate, told: LogFindings) -> list[str]:
    """Findings in the log, then what the innovations say about filter and model.

    Where a prediction is a thousand times further off than the channel moves, the model blows up between samples,
    and its Q and R are not to blame.
    """
    said = sentences(found.log.findings) + ([found.restarts.sentence] if found.restarts else [])
    spoilt = [one for one in found.log.findings if one.kind in SPOILING]
    if any(one.kind == GAP for one in spoilt):
        said.append("At a gap the filter predicts with the last input held.")
    if not told.rows:
        return [
            *said,
            f"Nothing was measured in the rows that count, from {told.first} on: there are no innovations.",
        ]
    if all(isnan(one.rmse) for one in told.predictions):
        silent = "This estimator gives no innovation, so there is no NIS, no whiteness and no likelihood."
        return [*said, silent]
    names = [one.name for one in found.log.measured]
    blown = blow_up_sentence(found.innovations[told.first :], found.log.measurements, names, found.log.dt)
    if blown:
        return [*said, blown]
    if isnan(told.mean_nis):
        return [*said, "This filter gives no covariance, so there is no NIS and no likelihood."]
    low, high = told.nis_band
    some = "The mean NIS is in its 95 % band."
    if told.mean_nis > high:
        some = "The innovations are larger than the filter expects: its Q or R is too small, or the model is off."
    elif told.mean_nis < low:
        some = "The innovations are smaller than the filter expects: its Q or R is too large."
    if told.whiteness is not None and told.whiteness.p_value < ALPHA:
        some += " They are not white: the filter could have known some of them."
    if spoilt:
        kinds = list(dict.fromkeys(one.kind for one in spoilt))
        some += f" But this is with what was found in the log ({', '.join(kinds)}): mend that first."
    return [*said, some]
