"""Random scenarios from a seed, each driven, judged by the oracles and made smaller when it fails."""
