"""`python -m trilight`, also under torchrun: the command line."""

from infra.cli.app import main

if __name__ == "__main__":
    main()
