"""The VAE and the LSTM autoencoder: training, pretrained weights and linear probes."""
