"""The tests, the models they share (`tests.models`), and naive computations to compare with (`tests.oracles`)."""
