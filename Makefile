# The two commands of the README. Both do all the set-up themselves; see `make help`.
.POSIX:
CARGO ?= cargo
TARGET = $${CARGO_TARGET_DIR:-target}
ICTUS = $(TARGET)/release/ictus

.PHONY: help run test build setup

help:
	@echo 'make run    build, start the Autoware federation (24 federates) here, show it, tear it down'
	@echo 'make test   run every test'

setup:
	@.ci/setup

build: setup
	$(CARGO) build --release --package ictus-cli

run: build
	@ICTUS=$(ICTUS) .ci/show compose/autoware/federation.yaml

test:
	@.ci/setup hosts
	.ci/test
