"""What can be downloaded: a dataset, a network and a page of pictures, ready for a hub."""
