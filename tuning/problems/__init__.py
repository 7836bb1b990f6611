"""Problems of studies: found by name, with their data and scale."""
