function [text, etag] = ask(path, body, seen)
% One request by curl: the answer's text, and its ETag. body is JSON, or ''; seen is an ETag, or ''.
    place = strrep(tempname(), '\', '/');
    file = fopen([place '.in'], 'w'); fwrite(file, body); fclose(file);
    file = fopen([place '.curl'], 'w');
    fprintf(file, 'url = "%s%s"\n', getenv('URL'), path);
    fprintf(file, 'header = "Authorization: Bearer %s"\n', getenv('KEY'));
    fprintf(file, 'header = "Content-Type: application/json"\n');
    if ~isempty(body), fprintf(file, 'data-binary = "@%s.in"\n', place); end
    if ~isempty(seen), fprintf(file, 'header = "If-Match: %s"\n', strrep(seen, '"', '\"')); end
    fprintf(file, 'output = "%s.out"\ndump-header = "%s.head"\nmax-time = 60\nsilent\nshow-error\nfail-with-body\n', place, place);
    fclose(file);
    [failed, said] = system(['curl -K "' place '.curl"']);
    text = ''; head = '';
    if exist([place '.out'], 'file'), text = fileread([place '.out']); end
    if exist([place '.head'], 'file'), head = fileread([place '.head']); end
    delete([place '.*']);
    if failed, error('stimrig:refused', '%s', [said text]); end
    found = regexpi(head, 'etag: *(\S+)', 'tokens', 'once');
    etag = [found{:}];
end
