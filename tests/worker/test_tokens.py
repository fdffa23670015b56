from __future__ import annotations

import hashlib
import secrets
from datetime import UTC, datetime, timedelta

import pytest
from pliant.worker.errors import InvalidRequest, StoreUnavailable, UnknownToken
from pliant.worker.settings import Settings
from pliant.worker.store.connection import connect
from pliant.worker.tokens import PREFIX, Scope, Token, Tokens, parse_duration


@pytest.fixture
def tokens(settings: Settings) -> Tokens:
    return Tokens.open(settings)


def test_only_a_complete_token_is_recognised(tokens: Tokens) -> None:
    token, text = tokens.create(" ada  l. ", scopes=[Scope.READ, Scope.READ])
    assert tokens.recognise(text) == token
    assert (token.name, token.scopes, token.owner) == ("ada l.", (Scope.READ,), token.id)
    other, _ = tokens.create("other")
    wrong = [
        text[:-1],
        text + "x",
        text.upper(),
        f" {text}",
        text.replace(token.id, other.id),
        text[:-1] + ("A" if text[-1] != "A" else "B"),
        "",
        token.id,
        token.sha256,
        f"pliant_{token.id}_{token.sha256}",
        text.replace("pliant_", "pliant_\n"),
    ]
    assert [each for each in wrong if tokens.recognise(each) is not None] == []


def test_the_store_holds_a_digest_and_never_the_token(tokens: Tokens, settings: Settings) -> None:
    token, text = tokens.create("ada")
    client = connect(settings.redis, decode=True)
    kept = str(client.hgetall(f"{settings.queue}:tokens"))
    client.close()
    assert hashlib.sha256(text.encode()).hexdigest() in kept
    assert token.id in kept
    assert text.split("_", 2)[2] not in kept  # the secret, which may contain _ itself
    assert text not in kept


def test_secrets_are_unique_and_32_bytes_long(tokens: Tokens) -> None:
    made = {tokens.create("same name")[1] for _ in range(50)}
    assert len({text.split("_", 2)[2] for text in made}) == 50
    assert all(len(text.split("_", 2)[2]) == 43 for text in made)  # 32 bytes in base64


def test_a_revoked_token_is_unknown_at_once(tokens: Tokens) -> None:
    token, text = tokens.create("ada")
    assert [each.id for each in tokens.all()] == [token.id]
    assert tokens.revoke(token.id) == token
    assert tokens.recognise(text) is None
    assert tokens.all() == []
    with pytest.raises(UnknownToken, match="pliant token list"):
        tokens.revoke(token.id)
    with pytest.raises(UnknownToken):
        tokens.create("x", sharing=token.id)


def test_a_revoked_token_is_not_registered_again(tokens: Tokens) -> None:
    """Otherwise each start of a deployment that registers its first token would undo the revocation."""
    _, text = tokens.create("first", scopes=[Scope.ADMIN])
    token, _ = tokens.create("first", scopes=[Scope.ADMIN], text=text)
    assert token == tokens.recognise(text)
    tokens.revoke(token.id)
    again, _ = tokens.create("first", scopes=[Scope.ADMIN], text=text)
    assert again.revoked
    assert not again.may(Scope.READ)
    assert tokens.recognise(text) is None
    assert tokens.all() == []


def test_a_token_expires_at_its_time_and_not_before(settings: Settings) -> None:
    now = datetime(2026, 5, 4, 9, 30, tzinfo=UTC)
    tokens = Tokens(connect(settings.redis, decode=True), prefix=settings.queue, clock=lambda: now)
    token, _ = tokens.create("ada", expires=timedelta(hours=1))
    assert not token.expired(now + timedelta(minutes=59, seconds=59))
    assert token.expired(now + timedelta(hours=1))
    forever, _ = tokens.create("for ever")
    assert not forever.expired(now + timedelta(days=36500))


def test_tokens_may_share_jobs(tokens: Tokens) -> None:
    first, _ = tokens.create("old")
    second, _ = tokens.create("new", sharing=first.id)
    third, _ = tokens.create("newer", sharing=second.id)
    assert first.id == second.owner == third.owner
    with pytest.raises(UnknownToken):
        tokens.create("x", sharing="0" * 12)


def test_admin_grants_every_scope_and_others_only_their_own(tokens: Tokens) -> None:
    def made(*scopes: Scope) -> Token:
        return tokens.create("x", scopes=scopes)[0]

    assert [made(Scope.ADMIN).may(each) for each in Scope] == [True, True, True]
    assert [made(Scope.READ).may(each) for each in Scope] == [True, False, False]
    assert [made(Scope.SUBMIT).may(each) for each in Scope] == [False, True, False]
    assert [made(each).sees_all for each in Scope] == [False, False, True]


@pytest.mark.parametrize("name", ["", "   ", "n" * 101, "a\x00b"])
def test_token_names_are_validated(tokens: Tokens, name: str) -> None:
    with pytest.raises(InvalidRequest, match="printable characters"):
        tokens.create(name)


def test_a_token_without_scopes_is_refused(tokens: Tokens) -> None:
    with pytest.raises(InvalidRequest, match="read, submit, admin"):
        tokens.create("x", scopes=[])


def test_durations_are_parsed_and_invalid_ones_refused() -> None:
    assert parse_duration("90d") == timedelta(days=90)
    assert parse_duration(" 12h ") == timedelta(hours=12)
    assert [parse_duration(f"2{unit}") for unit in "smw"] == [
        timedelta(seconds=2),
        timedelta(minutes=2),
        timedelta(weeks=2),
    ]
    for wrong in ("", "0d", "d", "9", "-1d", "1y", "1.5h", "٣d", "9999999d"):
        with pytest.raises(InvalidRequest, match="12h, 90d"):
            parse_duration(wrong)


def test_durations_are_limited_so_that_expiry_is_a_valid_date() -> None:
    longest = parse_duration("999999d")
    assert datetime.now(UTC) + longest < datetime.max.replace(tzinfo=UTC)
    assert parse_duration("142857w") == longest
    with pytest.raises(InvalidRequest, match=r"expected a duration .*, at most 999999d, got '142858w'") as caught:
        parse_duration("142858w")
    assert caught.value.code == "invalid_duration"


def test_an_unavailable_store_is_an_error(tmp_path: object) -> None:
    tokens = Tokens(connect(f"unix://{tmp_path}/nobody.sock", decode=True, retries=0), prefix="x")
    with pytest.raises(StoreUnavailable):
        tokens.recognise(f"pliant_{'0' * 12}_{secrets.token_urlsafe(32)}")
    with pytest.raises(StoreUnavailable):
        tokens.all()


def test_a_token_provided_by_a_deployment_is_adopted_once(tokens: Tokens) -> None:
    text = f"{PREFIX}0123456789ab_{'x' * 43}"
    first, same = tokens.create("first", scopes=(Scope.ADMIN,), text=text)
    assert (same, first.id, first.scopes) == (text, "0123456789ab", (Scope.ADMIN,))
    again, _ = tokens.create("another name", scopes=(Scope.READ,), text=text)
    assert again == first
    assert tokens.recognise(text) == first
    assert tokens.all() == [first]
    with pytest.raises(InvalidRequest) as caught:
        tokens.create("first", text="pliant_short")
    assert caught.value.code == "invalid_token_text"
    assert "short" not in str(caught.value)
