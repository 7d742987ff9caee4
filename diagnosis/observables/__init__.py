"""What a campaign tells at each tap of the chain, from logs to material."""
