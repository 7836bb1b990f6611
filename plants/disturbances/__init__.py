"""What disturbs any plant: effects as frozen values, sensors and recorded series."""
