"""Is a filter consistent? Its errors and innovations held against the covariance that it claims."""
