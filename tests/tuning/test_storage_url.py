"""No message shows who logs in to a storage, with what password or option."""

import re

import optuna
import pytest
import sqlalchemy

from tuning.api.report import find_subject
from tuning.search import storage as database
from tuning.search.storage import open_storage, public_url, without_secrets

SHOWN = {
    "postgresql+psycopg2://tuner:secret@host:5432/studies": "postgresql+psycopg2://host:5432/studies",
    "postgresql://tuner@10.77.5.1/studies": "postgresql://10.77.5.1/studies",
    "postgresql://host/studies?user=tuner&password=secret": "postgresql://host/studies",
    "postgresql://tuner@host/studies?password=se@cret": "postgresql://***",
    "postgresql:///studies?host=/run&password=se@cret": "postgresql:///studies",
    "postgresql://tuner:se/cret@host/studies": "postgresql://host/studies",
    "postgresql://tuner:se@cret@host/studies": "postgresql://host/studies",
    "postgresql://tuner:se/cr@et@host:5432/studies?sslmode=require": "postgresql://host:5432/studies",
    "postgresql://tuner:se?cret@host/studies": "postgresql://***",
    "postgresql://tuner:se#cret@host/studies": "postgresql://***",
    "postgresql://tuner:secret/studies": "postgresql://***",
    "postgresql://tuner:secret": "postgresql://***",
    "postgresql://tuner:secret@[::1]:5432/studies": "postgresql://[::1]:5432/studies",
    "mysql+pymysql://tuner:se%40cret@host/studies": "mysql+pymysql://host/studies",
    "tuner:secret@host://studies": "***",
    "postgresql:/tuner:secret@host/studies": "postgresql:***",
    "postgresql+psycopg2:tuner:secret@host/studies": "postgresql+psycopg2:***",
    "grpc://tuner:secret@host:13000": "grpc://host:13000",
    "sqlite:////data/a@b/s.db?password=secret": "sqlite:////data/a@b/s.db",
    "out/studies.journal": "out/studies.journal",
    "/data/a@b/studies.journal": "/data/a@b/studies.journal",
    "postgresql/studies.journal": "postgresql/studies.journal",
}


@pytest.mark.parametrize(("storage", "shown"), SHOWN.items(), ids=list(SHOWN))
def test_scheme_host_and_database_are_shown_and_nothing_else(storage, shown):
    assert public_url(storage) == shown
    said = f"could not connect to {storage}: password secret, or cret@host, or se"
    said = without_secrets(said, storage)
    if shown != storage:
        assert storage not in said and shown in said
        assert not re.search(r"\bsecret\b|se.cret", said) or "secret" not in storage


@pytest.mark.parametrize(
    ("storage", "said", "clean"),
    [
        (
            "postgresql://tuner:pa@ss@host/studies",  # as SQLAlchemy hands the rest to a driver
            'could not translate host name "ss@host" to address',
            'could not translate host name "***@host" to address',
        ),
        ("grpc://tuner:secret/x", "Port could not be cast to integer value as 'secret'", "value as '***'"),
        ("mysql://tuner:p%40ss@host/s", "access denied with p@ss or p%40ss, passed", "with *** or ***, passed"),
        (
            "postgresql://host/s?password=hush",
            'invalid dsn: "host=host password=hush"',
            '"host=host password=***"',
        ),
        ("postgresql://tuner:pw@host/s", 'authentication failed for user "tuner"', 'for user "tuner"'),
        ("out/studies.journal", "a journal: out", "a journal: out"),
    ],
)
def test_a_message_loses_every_part_of_a_password(storage, said, clean):
    assert without_secrets(said, storage).endswith(clean)


SECRET = [
    "postgresql+psycopg2://tuner:secret@localhost:1/s",
    "postgresql+psycopg2://localhost:1/s?user=tuner&password=secret",
    "postgresql+psycopg2://tuner:sec/secret@localhost:1/s",
    "postgresql+psycopg2://tuner:sec@secret@localhost:1/s",
    "postgresql+psycopg2://tuner:secret/s",
    "grpc://tuner:secret/s",
    "nonsense://tuner:secret@localhost/s",
    "postgresql:/tuner:secret@localhost/s",
]


@pytest.mark.parametrize("url", SECRET)
def test_a_storage_that_cannot_be_reached_tells_no_password(url, tmp_path, monkeypatch):
    pytest.importorskip("psycopg2")
    pytest.importorskip("grpc")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(database, "PROXY_SECONDS", 0.01)
    with pytest.raises(
        ValueError, match=f"storage must be .* but got {url.partition(':')[0].replace('+', '.')}:"
    ) as e:
        open_storage(url)
    assert "secret" not in str(e.value) and "tuner:" not in str(e.value) and "\n" not in str(e.value)
    assert not list(tmp_path.iterdir())


def test_an_outage_tells_no_password(tmp_path, monkeypatch):
    monkeypatch.setattr(database, "PATIENCE_SECONDS", 0.6)
    storage, url = open_storage(f"sqlite:///{tmp_path}/s.db"), "postgresql://tuner:secret@host/s"
    study = optuna.create_study(storage=storage)

    def away(*arguments):
        cause = sqlalchemy.exc.OperationalError("SELECT 1", {}, Exception(f"no answer from {url}"))
        raise optuna.exceptions.StorageInternalError("away") from cause

    monkeypatch.setattr(storage._backend, "url", url)
    monkeypatch.setattr(storage._backend, "set_study_user_attr", away)
    said = "no answer from postgresql://host/s$"
    with pytest.warns(UserWarning, match=said), pytest.raises(ValueError, match=said):
        study.set_user_attr("a", 1)


def test_a_report_of_a_study_that_is_not_there_tells_no_password(monkeypatch):
    monkeypatch.setattr("tuning.api.report._load", lambda name, storage: None)
    with pytest.raises(ValueError, match="of a study in postgresql://host/s, but got 'none'"):
        find_subject("none", "postgresql://tuner:secret@host/s")
