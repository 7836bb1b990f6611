"""How vehicles are kept in memory and stepped: one compiled step for a single env, batches and the vector env."""
