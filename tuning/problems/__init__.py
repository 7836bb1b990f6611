"""What a study needs to know of a plant: problems by name, their data and scale."""
