"""Neural modules: VAE, sequence autoencoder, GWR-B, actor and critic."""
