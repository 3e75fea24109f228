"""The VAE and the LSTM autoencoder: training, the shipped weights, probes of their latents."""
