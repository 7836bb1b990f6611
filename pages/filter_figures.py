"""Make the pictures of docs/filters.md and its computed tables.

    python -m pages.filter_figures [FOLDER]

The pictures go into FOLDER, docs/ by default. If there is a filters.md in it, its tables between the comments
`<!-- table NAME -->` and `<!-- end -->` are written anew. Every run gives the same.
"""

from __future__ import annotations

from collections.abc import Sequence

from pages import (
    filter_fuzzy,
    filter_gaussian,
    filter_horizon,
    filter_models,
    filter_noise,
    filter_particles,
    filter_sampled,
    filter_tables,
)
from pages.page import make_page

FIGURES = {
    "filters_kalman.png": filter_gaussian.kalman,
    "filters_update.png": filter_gaussian.one_update,
    "filters_points.png": filter_gaussian.sigma_points,
    "filters_horizon.png": filter_horizon.reactor,
    "filters_ensembles.png": filter_sampled.ensembles,
    "filters_modes.png": filter_sampled.modes,
    "filters_particles.png": filter_particles.kinds,
    "filters_weighted.png": filter_models.weighted,
    "filters_several.png": filter_models.several,
    "filters_fuzzy.png": filter_fuzzy.picture,
    "filters_adaptive.png": filter_noise.adaptive,
    "filters_baselines.png": filter_noise.baselines,
    "filters_smoothers.png": filter_gaussian.smoothers,
    "filters_augmented.png": filter_noise.augmented,
    "filters_varying.png": filter_noise.varying,
}
TABLES = filter_tables.TABLES | {"fuzzy": filter_fuzzy.fuzzy}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("filters", "pages.filter_figures", FIGURES, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
