"""Is a filter honest? Its errors and innovations held against the covariance that it claims."""
